"""Claims about specimens, on points and surfaces whose errors are known."""

from types import SimpleNamespace

import numpy as np
import pytest

from greenough.pipeline.compare import ErrorRow
from greenough.pipeline.reconstruct import PointMap
from greenough.twin.validation.measured import (
    DECONVOLVED,
    DECONVOLVED_FILTERED,
    FILTERED,
    RAW,
    Measured,
    noise_quantile,
)
from greenough.twin.validation.specimens import specimen_claims

SHAPE = (4, 6)


def measured(name="coin", treatment=RAW, bias_um=0.5, p95_um=3.0, share=0.99, sigma_mm=1e-3) -> Measured:
    everywhere = np.ones(SHAPE, bool)
    points = PointMap(np.zeros((*SHAPE, 3)))
    error = ErrorRow("vertical", "smooth", 20, bias_um, 2.0, p95_um, 9.0)
    truth = SimpleNamespace(lit_and_seen=everywhere)
    sigma = np.full(SHAPE, sigma_mm)
    return Measured(name, treatment, np.zeros(SHAPE), points, sigma, truth, everywhere, error, share)


def rows(setup, of: Measured) -> dict:
    return {row.claim: row for row in specimen_claims(setup, of)}


def test_rows_are_the_vertical_ones_on_smooth_surface_with_the_noise_beside_them(analytic):
    found = rows(analytic(), measured())
    assert [found[name].measured for name in ("bias", "rmse", "p95", "valid_share")] == [0.5, 2.0, 3.0, 0.99]
    assert [found[name].n for name in ("bias", "rmse", "p95", "valid_share")] == [20, 20, 20, 24]
    assert {(row.specimen, row.filter, row.alignment, row.holds) for row in found.values()} == {
        ("coin", "none", "none", None)
    }
    # 95 % of normal deviates lie within 1.96 standard deviations.
    assert found["rmse"].criterion.endswith("; noise alone makes 1.00 um")
    assert found["p95"].criterion.endswith("; noise alone makes 1.96 um")
    assert {row.predicted for row in found.values()} == {None}  # noise is not all that is expected


@pytest.mark.parametrize(("name", "treatment"), [("diaphragm-raised", FILTERED), ("coin", DECONVOLVED_FILTERED)])
def test_the_best_treatment_has_limits_that_can_be_missed_and_is_expected_to_keep(analytic, name, treatment):
    good = rows(analytic(method="bundle"), measured(name, treatment, bias_um=-1.0, p95_um=4.0, share=0.98))
    bad = rows(
        analytic(method="bundle"), measured(name, treatment, bias_um=-1.01, p95_um=4.01, share=0.979, sigma_mm=5e-3)
    )
    for row in ("bias", "p95", "valid_share"):
        assert good[f"{row}_{treatment}"].holds is True
        assert bad[f"{row}_{treatment}"].holds is False
    assert {row.expected_to_hold for row in bad.values() if row.limit is not None} == {True}


@pytest.mark.parametrize(
    ("method", "name", "treatment"),
    [
        ("paper", "coin", FILTERED),
        ("bundle", "coin", RAW),
        ("bundle", "coin", DECONVOLVED),
        ("bundle", "coin", FILTERED),  # for want of a point spread
        ("bundle", "bga", DECONVOLVED_FILTERED),
    ],
)
def test_other_rows_only_report(analytic, method, name, treatment):
    found = rows(analytic(method=method), measured(name, treatment, bias_um=10.0, p95_um=20.0, share=0.5))
    assert {(row.limit, row.holds, row.expected_to_hold) for row in found.values()} == {(None, None, None)}


def test_the_quantile_of_noise_is_that_of_draws():
    """10^6 draws: the 95 % point is known to sqrt(0.95 x 0.05 / 10^6) = 0.02 % of the share; five of these."""
    rng = np.random.default_rng(7)
    sigma = rng.lognormal(0, 1, 1_000_000)
    drawn = np.abs(sigma * rng.standard_normal(len(sigma)))
    # Every fiftieth pixel stands for all: its own sampling is 0.2 % of the share.
    assert np.mean(drawn <= noise_quantile(sigma)) == pytest.approx(0.95, abs=0.005)
    assert np.mean(drawn <= noise_quantile(sigma, 0.5)) == pytest.approx(0.5, abs=0.02)


def test_noise_that_is_zero_or_unknown():
    assert noise_quantile(np.zeros(5)) == 0.0
    assert np.isnan(noise_quantile(np.array([np.nan])))
    assert noise_quantile(np.array([0.0, 0.0, np.nan, 2.0]), 0.9) == pytest.approx(2 * 1.0364, rel=1e-3)
