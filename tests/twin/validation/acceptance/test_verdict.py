"""Claims about the verdict of an acceptance: an artefact that fails or is missing is never reported as fine."""

import math
from pathlib import Path

import pytest

from greenough.twin.validation.acceptance import table
from greenough.twin.validation.acceptance.rows import Row
from greenough.twin.validation.acceptance.verdict import artefact_lines, plain, screen_lines, sentence
from greenough.twin.validation.judged_table import JudgedTable

NAMES = {"sphere": ("sphere_form_95", "sphere_size_95"), "plane": ("flatness_95_largest",)}


def row(name: str, holds: bool | None = True, value: float = 1.234, u: float | None = 0.012) -> Row:
    limit = None if holds is None else 8.0
    return Row(name, value, "um", None, None, limit, holds, u, 9, "none", "none", "bundle", 1, "a criterion")


def found(*holds: bool | None, missing: tuple[str, ...] = ()) -> JudgedTable[Row]:
    names = [name for names in NAMES.values() for name in names if name not in missing]
    return JudgedTable(
        tuple(row(name, each) for name, each in zip(names, holds, strict=True)), dict.fromkeys(missing, "no light")
    )


def screen(of: JudgedTable[Row], out: str = "acceptance.json") -> list[str]:
    return screen_lines(of, artefact_lines(of, NAMES, {}), Path(out))


def test_a_table_whose_rows_hold_is_kept_and_has_a_line_for_each_artefact():
    lines = screen(found(True, None, True))
    assert lines[0] == "The twin keeps its claims: all 2 rows with a limit hold."
    assert lines[2].split("  ")[0] == "sphere"
    assert "1.234 ± 0.012 µm" in lines[2]
    assert [line.endswith("holds") for line in lines[2:4]] == [True, True]
    assert lines[-1] == "All 3 rows with their criteria: acceptance.json"


@pytest.mark.parametrize("place", range(3))
def test_a_row_that_fails_is_named_and_its_artefact_fails(place):
    holds = [True] * 3
    holds[place] = False
    of = found(*holds)
    lines = artefact_lines(of, NAMES, {})
    assert [line.verdict for line in lines] == (["fails", "holds"] if place < 2 else ["holds", "fails"])
    assert [line.unexpected for line in lines] == [place < 2, place == 2]
    text = " ".join(screen(of))
    assert "does not keep its claims: of 3 rows with a limit 1 does not hold, and 0 rows are missing" in text
    assert f"Not holding: {of.not_holding[0]}." in text


@pytest.mark.parametrize("missing", ["sphere_size_95", "flatness_95_largest"])
def test_a_missing_row_is_named_with_its_reason_and_its_artefact_is_not_measured(missing):
    of = found(True, True, missing=(missing,))
    assert [line.verdict for line in artefact_lines(of, NAMES, {}) if missing in line.rows] == ["not measured"]
    text = " ".join(screen(of))
    assert "1 row is missing" in text
    assert f"Missing: {missing} (no light)." in text


def test_a_row_of_no_artefact_is_not_lost():
    of = JudgedTable((row("unheard_of", False),), {})
    (line,) = artefact_lines(of, {}, {})
    assert (line.artefact, line.fail, line.verdict) == ("others", 1, "fails")


@pytest.mark.parametrize("value", [1e-9, -1e9, math.nan, math.inf, 0.0])
@pytest.mark.parametrize("u", [None, 1e-12, 1e12])
def test_the_screen_holds_extreme_figures_long_reasons_and_paths(value, u):
    rows = tuple(row(name, False, value, u) for name in NAMES["sphere"])
    of = JudgedTable(rows, {f"a_long_name_{k}": "a long reason " * 30 for k in range(200)})
    lines = screen(of, "/tmp/" + "folder/" * 60 + "acceptance.json")
    assert len(lines) <= 25
    assert max(map(len, lines)) <= 100
    assert "200 rows are missing" in " ".join(lines)


def test_every_artefact_of_the_real_table_has_a_line_and_a_row_that_stands_for_it():
    lines = table.verdict_lines(JudgedTable((), {}))
    assert [line.artefact for line in lines] == list(table.GROUPS)
    for group in table.GROUPS.values():
        assert not group.headline or group.headline in group.names


def test_the_lines_in_the_file_name_all_rows_of_their_artefact():
    lines = plain(artefact_lines(found(True, True, True), NAMES, {}))
    assert {line["artefact"]: tuple(line["rows"]) for line in lines} == NAMES
    assert sentence(found(True, True, True)).startswith("The twin keeps its claims")
