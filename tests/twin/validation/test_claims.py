"""Claims about the rows that state claims."""

import json
from dataclasses import fields

import numpy as np
import pytest

from greenough.twin.validation.claims import Claim, environment, write_claims


def row(**changes) -> Claim:
    values = {
        "claim": "depth", "specimen": "plane", "paper": 4.0, "measured": 3.0, "unit": "um", "n": 7, "filter": "none",
        "alignment": "none", "calibration": "paper", "seed": 1, "limit": 4.0, "holds": True, "expected_to_hold": True,
        "criterion": "", "predicted": None,
    }  # fmt: skip
    return Claim(**(values | changes))


@pytest.mark.parametrize(
    ("holds", "expected", "as_expected"),
    [(True, True, True), (False, True, False), (True, False, False), (False, False, True), (None, None, True)],
)
def test_a_row_is_as_expected_if_it_holds_where_it_should_and_fails_where_it_cannot(holds, expected, as_expected):
    assert row(holds=holds, expected_to_hold=expected).as_expected is as_expected


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
