"""Claims about the rows that state claims."""

import json
from dataclasses import fields

import numpy as np
import pytest

from greenough.twin.validation.claims import TOSS_UP_SDS, Claim, environment, expectation, write_claims


def row(**changes) -> Claim:
    values = {
        "claim": "depth", "specimen": "plane", "paper": 4.0, "measured": 3.0, "unit": "um", "n": 7, "filter": "none",
        "alignment": "none", "calibration": "paper", "seed": 1, "limit": 4.0, "holds": True, "expected_to_hold": True,
        "criterion": "", "predicted": None, "predicted_sd": None,
    }  # fmt: skip
    return Claim(**(values | changes))


@pytest.mark.parametrize(
    ("holds", "expected", "as_expected"),
    [
        (True, True, True), (False, True, False), (True, False, False), (False, False, True), (None, None, True),
        (True, None, True), (False, None, True),
    ],
)  # fmt: skip
def test_a_row_is_as_expected_if_it_holds_where_it_should_and_fails_where_it_cannot(holds, expected, as_expected):
    assert row(holds=holds, expected_to_hold=expected).as_expected is as_expected


@pytest.mark.parametrize("predicted_to_hold", [True, False])
def test_a_prediction_is_open_only_within_its_own_spread_of_the_limit(predicted_to_hold):
    assert expectation(predicted_to_hold, 0.3, 0.101) is None
    assert expectation(predicted_to_hold, 0.3, 0.099) is predicted_to_hold
    assert expectation(predicted_to_hold, 0.0, None) is predicted_to_hold


def test_a_row_on_the_rim_of_the_open_zone_raises_one_false_alarm_in_740():
    """One million figures, normal about a prediction just outside: 1350 ± 37 on the other side, 5 of these."""
    figures = np.random.default_rng(1).normal(4.0 - TOSS_UP_SDS * 0.1, 0.1, 1_000_000)
    assert np.mean(figures > 4.0) == pytest.approx(1 / 740.8, abs=5 * 37e-6)


def test_file_holds_every_field_of_every_row_and_the_environment(tmp_path):
    path = tmp_path / "claims.json"
    write_claims(path, [row(), row(claim="noise", paper=None)], {"rig": "twin"})
    document = json.loads(path.read_text())
    assert [set(claim) for claim in document["claims"]] == [{field.name for field in fields(Claim)}] * 2
    assert [Claim(**claim) for claim in document["claims"]] == [row(), row(claim="noise", paper=None)]
    assert document["environment"] == environment() | {"rig": "twin"}


@pytest.mark.parametrize("nothing", [float("nan"), float("inf"), np.float64("nan")])
def test_a_figure_that_could_not_be_measured_is_null_in_the_file(tmp_path, nothing):
    write_claims(tmp_path / "claims.json", [row(measured=nothing, holds=False)], {})
    assert json.loads((tmp_path / "claims.json").read_text())["claims"][0]["measured"] is None


def test_a_file_that_cannot_be_written_leaves_the_old_one(tmp_path):
    path = tmp_path / "claims.json"
    write_claims(path, [row()], {})
    before = path.read_bytes()
    with pytest.raises(TypeError):
        write_claims(path, [row()], {"rig": object()})
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]
