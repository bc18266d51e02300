"""Claims about a demo's verdict: every claim of the paper has a line, and none is glossed over."""

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from greenough.pipeline.report.verdict_table import FAILS, HOLDS, NOT_MEASURED
from greenough.twin.validation.claims import Claim, write_claims
from greenough.twin.validation.verdict import SAID, screen_lines, verdict_of

PAPER = (
    "depth error", "paper's method", "stage of 10", "plane RMSE, one exposure", "plane noise", "circle distance, mean",
    "circle distance, RMSE", "reprojection RMSE, u", "reprojection RMSE, v", "volume, length", "volume, width",
    "volume, height", "coin", "ball height", "ball diameter", "coplanarity", "diaphragm concave",
    "diaphragm equilibrated", "diaphragm raised",
)  # fmt: skip
"""What the paper claims, by words that must be found."""


def row(**changes: Any) -> Claim:
    values = {
        "claim": "depth_p95_volume", "specimen": "plane", "paper": 4.0, "measured": 2.345, "unit": "um", "n": 7,
        "filter": "plane under a gaussian on phasors, fwhm 4.31 px", "alignment": "none", "calibration": "bundle",
        "seed": 1, "limit": 4.0, "holds": True, "expected_to_hold": True, "criterion": "", "predicted": None,
        "predicted_sd": None,
    }  # fmt: skip
    return Claim(**(values | changes))


def all_rows(**changes: Any) -> list[Claim]:
    """A row for every line of the verdict, each with these changes."""
    return [
        row(
            claim=said.rows[0].replace("*", "_mean"), specimen=said.specimen, calibration=said.calibration,
            unit=said.unit, **changes,
        )
        for said in SAID
    ]  # fmt: skip


def line_of(claims: list[Claim], words: str):
    (line,) = [line for line in verdict_of(claims).lines if line.claim.startswith(words)]
    return line


@pytest.mark.parametrize("claims", [[], all_rows()], ids=["no rows", "all rows"])
def test_every_claim_of_the_paper_is_named(claims):
    screen = "\n".join(screen_lines(verdict_of(claims), Path("demo")))
    assert [words for words in PAPER if words not in screen] == []


def test_a_claim_without_a_row_is_not_measured_and_never_fine():
    verdict = verdict_of([])
    assert {line.verdict for line in verdict.lines} == {NOT_MEASURED}
    lines = screen_lines(verdict, Path("demo"))
    assert sum(line.endswith("not measured") for line in lines) == len(SAID)
    assert not any("holds" in line for line in lines[1 : len(SAID) + 1])


EXTREME = (1e-9, -1e-9, 1e9, -1e9, 0.0, math.nan, math.inf, 123456.789, 0.00012345)


@pytest.mark.parametrize("uncertainty", [None, 1e-9, 0.0, 0.37, 1e9, math.nan])
@pytest.mark.parametrize("value", EXTREME)
def test_the_screen_holds_any_figure(value, uncertainty):
    claims = all_rows(
        measured=value, predicted=value, predicted_sd=uncertainty, limit=abs(value), holds=False, expected_to_hold=None
    )
    lines = screen_lines(verdict_of(claims), Path("build/demo"))
    assert len(lines) <= 25
    assert max(map(len, lines)) <= 100


@pytest.mark.parametrize("folder", ["demo", "/tmp/" + "a-long-folder/" * 9, "/tmp/" + "endless" * 90])
@pytest.mark.parametrize("wrong", [0, 1, 500])
def test_the_screen_holds_long_names_and_paths(folder, wrong):
    unexpected = [
        row(claim="a_name_that_does_not_end_" * 6 + str(k), specimen="specimen " * 20, holds=False)
        for k in range(wrong)
    ]
    claims = [*all_rows(), *unexpected]
    lines = screen_lines(verdict_of(claims), Path(folder))
    assert len(lines) <= 25
    assert max(map(len, lines)) <= 100
    assert ("otherwise" in " ".join(lines)) == bool(wrong)
    if wrong == 500:
        assert "500 otherwise" in " ".join(lines)


@pytest.mark.parametrize(
    ("holds", "expected", "word"),
    [
        (True, True, "holds"), (False, True, "fails"), (False, False, "fails, as predicted"),
        (True, False, "holds, unpredicted"), (True, None, "holds, borderline"), (False, None, "fails, borderline"),
        (None, None, "has no limit"),
    ],
)  # fmt: skip
def test_each_way_of_holding_has_its_word(holds, expected, word):
    line = line_of([row(holds=holds, expected_to_hold=expected)], "depth error")
    assert line.verdict == word
    assert line.unexpected == (not row(holds=holds, expected_to_hold=expected).as_expected)


@pytest.mark.parametrize(("holds", "expected"), [(False, True), (True, False)])
@pytest.mark.parametrize("place", range(len(SAID)))
def test_an_unexpected_row_is_never_reported_as_fine(place, holds, expected):
    claims = all_rows()
    claims[place] = replace(claims[place], holds=holds, expected_to_hold=expected)
    verdict = verdict_of(claims)
    assert verdict.lines[place].verdict != HOLDS
    assert verdict.lines[place].unexpected
    assert (verdict.judged, verdict.as_expected) == (len(claims), len(claims) - 1)
    text = " ".join(screen_lines(verdict, Path("demo")))
    assert f"{len(claims) - 1} behave as expected, 1 otherwise: {claims[place].claim}" in text


def test_an_unexpected_row_that_carries_no_line_is_named_too():
    claims = [*all_rows(), row(claim="depth_systematic_rms", holds=False)]
    text = " ".join(screen_lines(verdict_of(claims), Path("demo")))
    assert "1 otherwise: depth_systematic_rms (plane, bundle)" in text


def test_a_figure_that_could_not_be_measured_is_not_measured_though_its_row_is_there():
    line = line_of([row(measured=math.nan, n=0, holds=False)], "depth error")
    assert (line.measured, line.verdict, line.unexpected) == (None, NOT_MEASURED, True)


def test_an_uncertainty_is_shown_only_where_the_row_states_one():
    def screen(**changes):
        return screen_lines(verdict_of([row(**changes)]), Path("demo"))[1]

    assert "±" not in screen()
    assert "2.35 ± 0.04" in screen(predicted=2.3, predicted_sd=0.0412)
    assert "2.345 ± 0.012" in screen(predicted=2.3, predicted_sd=0.0123)


def test_the_true_distance_stands_beside_the_measured_one_and_others_stand_beside_their_limit():
    distance = row(
        claim="pitch_mean", specimen="board", unit="mm", measured=0.650031, predicted=0.649987, limit=0.0015,
        filter="phase averaged over each spot",
    )  # fmt: skip
    line = line_of([distance], "circle distance, mean")
    assert line.truth == 0.649987
    printed = screen_lines(verdict_of([distance, row(predicted=2.0)]), Path("demo"))
    (of_distance,) = [text for text in printed if text.startswith("circle distance, mean")]
    assert "0.65003" in of_distance
    assert "= 0.64999 mm" in of_distance
    (of_depth,) = [text for text in printed if text.startswith("depth error")]
    assert "≤ 4 µm" in of_depth


def test_figures_come_in_the_unit_of_the_paper():
    spread = row(claim="pitch_sd", specimen="board", unit="mm", measured=0.00091, limit=0.0011, predicted_sd=2e-5)
    line = line_of([spread], "circle distance, RMSE")
    assert (line.unit, line.measured, line.limit, line.uncertainty) == pytest.approx(("um", 0.91, 1.1, 0.02))


def test_words_say_which_filter_and_which_method():
    coin = row(claim="p95_deconvolved_filtered", specimen="coin", filter="deconvolved, plane under a gaussian")
    assert line_of([coin], "coin").claim == "coin 95 %, deconvolved, filtered"
    assert line_of([row()], "depth").claim == "depth error 95 %, filtered"
    spots = row(claim="reprojection_rmse_u", specimen="board", calibration="paper", filter="none")
    assert line_of([spots], "reprojection RMSE, u").claim == "reprojection RMSE, u, paper's method"


def test_a_row_of_another_calibration_or_specimen_does_not_carry_a_line():
    assert line_of([row(calibration="paper")], "depth error").verdict == NOT_MEASURED
    assert line_of([row(specimen="plane, stage of 10 um")], "depth error").verdict == NOT_MEASURED


def test_a_diameter_is_judged_as_soon_as_a_row_of_that_name_exists():
    reported = row(claim="ball_diameter_mean", specimen="bga", limit=None, holds=None, expected_to_hold=None)
    judged = row(claim="ball_diameter_largest_error", specimen="bga", holds=False)
    assert line_of([], "ball diameter").verdict == NOT_MEASURED
    assert line_of([reported], "ball diameter").verdict == "has no limit"
    line = line_of([reported, judged], "ball diameter")
    assert (line.row, line.verdict) == ("ball_diameter_largest_error", FAILS)


def test_the_file_keeps_all_rows_and_has_the_verdict_beside_them(tmp_path):
    claims = [*all_rows(), row(claim="other", measured=math.nan)]
    write_claims(tmp_path / "claims.json", claims, {}, verdict_of(claims).plain)
    document = json.loads((tmp_path / "claims.json").read_text(), parse_constant=pytest.fail)
    assert [each["claim"] for each in document["claims"]] == [claim.claim for claim in claims]
    assert [each["claim"] for each in document["verdict"]] == [line.claim for line in verdict_of(claims).lines]
    assert all(set(each) == set(document["verdict"][0]) for each in document["verdict"])
