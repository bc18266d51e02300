"""Claims about rows and the limits that grow with the number of points."""

import json
from dataclasses import asdict

import numpy as np
import pytest
from scipy.stats import norm

from greenough.twin.validation.acceptance.rows import CLAIM_UM, expected_range, range_limit_um, row


@pytest.mark.parametrize(
    ("value", "judged", "holds"),
    [(3.0, None, True), (-5.0, None, False), (1.1, 0.1, True), (4.5, 4.5, False), (np.nan, None, False)],
)
def test_a_row_holds_if_what_is_judged_keeps_to_the_limit_and_one_without_a_figure_does_not(
    setup, value, judged, holds
):
    assert row(setup, "figure", value, "um", 3, "some", limit=4.0, judged=judged).holds is holds


def test_a_row_without_a_limit_only_reports(setup):
    found = row(setup, "figure", 7.0, "um", 3, "some", peer=3.5)
    assert found.holds is None
    assert found.ratio == 2.0
    assert row(setup, "figure", 7.0, "um", 3, "some").ratio is None


def test_a_row_is_plain_json_and_an_unknown_uncertainty_is_none(setup):
    found = row(setup, "figure", np.float64(1), "um", np.int64(3), "some", limit=np.float32(2), u=np.nan)
    assert json.loads(json.dumps(asdict(found)))["u"] is None
    assert found.calibration == "bundle"
    assert found.seed == setup.bench.settings.seed


@pytest.mark.parametrize("n", [100, 1000, 20_000])
def test_the_limit_of_a_range_is_what_so_many_normal_deviates_span(n):
    """The mean of 400 ranges lies within 4.5 of its standard deviations: by chance once in 1e5."""
    sd = CLAIM_UM / norm.ppf(0.975)
    draws = sd * np.random.default_rng(1).standard_normal((400, n))
    spans = np.ptp(draws, axis=1)
    assert np.quantile(draws, 0.975) - np.quantile(draws, 0.025) == pytest.approx(2 * CLAIM_UM, rel=0.02)
    # Blom's approximation itself is good to half a per cent.
    assert abs(range_limit_um(n) - spans.mean()) < 4.5 * spans.std() / 20 + 0.005 * spans.mean()
    assert expected_range(n) * sd == pytest.approx(range_limit_um(n))
