"""Claims about the verdict of a study: failures and broken limits come first, and a screen holds what is printed."""

import math
from pathlib import Path
from typing import Any

import pytest

from greenough.twin.validation.benchmarks.rows import Row
from greenough.twin.validation.studies.study import Summary
from greenough.twin.validation.studies.verdict import limits, screen_lines, sentence

NONE_FAILED = Row("failed runs", 0, "", limit=0, holds=True)


def summary(*rows: Row, failures: int = 0, tables: dict[str, list[dict[str, Any]]] | None = None) -> Summary:
    failed = [{"case": str(k), "seed": k, "repeat": 1, "failure": "the board was not found"} for k in range(failures)]
    return Summary([NONE_FAILED, *rows], [], tables or {}, failed, [])


def limited(name: str, holds: bool | None, value: float = 0.25, limit: float | None = 0.5) -> Row:
    return Row(name, value, "µm", limit=limit, holds=holds)


def test_runs_failures_and_limits_are_counted_in_the_first_line():
    assert sentence(summary(), 12) == "12 runs, none failed; the study has no limits."
    assert sentence(summary(limited("a", True)), 1) == "1 run, none failed; all 1 limits hold."
    text = sentence(summary(limited("a", True), limited("b", False), failures=2), 12)
    assert text == "12 runs, 2 failed; 1 of 2 limits hold."


def test_limits_that_do_not_hold_come_first_and_each_has_a_line():
    of = summary(*(limited(f"row {k}", k != 3) for k in range(5)))
    assert [row.name for row in limits(of)] == ["row 3", "row 0", "row 1", "row 2", "row 4"]
    lines = screen_lines(of, 5, Path("out"))
    assert lines[2].startswith("row 3")
    assert lines[2].endswith("fails")
    assert sum(line.endswith("holds") for line in lines) == 4


def test_what_failed_is_told_with_its_reason_and_the_rest_is_counted():
    lines = screen_lines(summary(failures=5), 9, Path("out"))
    assert "Failed: case 0, seed 0: the board was not found" in lines
    assert "and 2 more failures, see summary.json" in lines


def test_tables_are_printed_where_they_fit_and_otherwise_counted():
    short, long = [{"case": "1", "mean": 0.5}], [{"case": str(k), "mean": 0.5} for k in range(60)]
    lines = screen_lines(summary(tables={"short": short, "long": long}), 1, Path("out"))
    assert "short:" in lines
    assert "long:" not in lines
    assert "1 table is too long for the screen." in lines
    assert lines[-1] == "Tables, rows and statistics are in out/summary.json"


@pytest.mark.parametrize("value", [1e-9, -1e9, math.nan, math.inf, 0.0, 123456.789])
def test_the_screen_holds_many_rows_long_names_and_extreme_figures(value):
    rows = [limited("a long name " * 20 + str(k), False, value, value) for k in range(300)]
    wide = [{f"column {k}": value for k in range(40)}]
    of = summary(*rows, failures=50, tables={"a title " * 30: wide, "other": wide * 100})
    lines = screen_lines(of, 300, Path("/tmp/" + "folder/" * 60))
    assert len(lines) <= 25
    assert max(map(len, lines)) <= 100
    assert f"and {300 - 14} more, see summary.json" in lines
