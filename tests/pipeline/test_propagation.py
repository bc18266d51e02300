"""Propagation against what can be worked out by hand, and against a Monte Carlo of its own."""

import numpy as np
import pytest
from scipy.stats import norm

from greenough.pipeline.calibration_uncertainty import CalibrationUncertainty
from greenough.pipeline.propagation import Estimate, estimate, propagate
from greenough.pipeline.reconstruct import PointMap

U, V = (grid.ravel() for grid in np.meshgrid(np.arange(0, 100, 4.0), np.arange(0, 80, 4.0)))
PIXELS = np.stack([U, V], axis=-1)


def uncertainty(fields, pattern=0.0):
    """Causes from functions of (u, v, z) that give displacements (..., 3), linear ones: the grid loses nothing."""
    z, v, u = np.meshgrid([-1.0, 1.0], [0.0, 80.0], [0.0, 100.0], indexing="ij")
    modes = np.array([np.moveaxis(np.array(field(u, v, z)), 0, -1) for field in fields], dtype=np.float32)
    return CalibrationUncertainty(
        np.array([-1.0, 1.0]), np.array([0.0, 80.0]), np.array([0.0, 100.0]),
        modes.reshape(-1, 2, 2, 2, 3), np.full(2, pattern),
    )  # fmt: skip


def lift(u, v, z):
    return 0 * z, 0 * z, 0 * z + 2e-3


def scale(u, v, z):
    return 0 * z, 0 * z, 3e-3 * z


def tilt(u, v, z):
    return 0 * z, 0 * z, 1e-5 * (u - 48)


def points(z):
    return np.column_stack([0.01 * U, 0.01 * V, np.broadcast_to(z, U.shape)])


def mean_height(xyz):
    return float(xyz[:, 2].mean())


def test_a_mean_height_bears_what_all_points_share_and_a_share_of_the_noise():
    noise = np.tile([0.0, 0.0, 1.5e-3], (len(U), 1))
    found = propagate(
        mean_height, points(0.5), PIXELS, uncertainty([lift, scale, tilt]), noise, np.random.default_rng(1)
    )
    assert found.value == pytest.approx(0.5)
    assert found.calibration_sd == pytest.approx(np.hypot(2e-3, 1.5e-3), rel=1e-5)
    assert found.noise_sd == pytest.approx(1.5e-3 / np.sqrt(len(U)), rel=4 / np.sqrt(2 * 200))
    assert found.sd == pytest.approx(np.hypot(found.noise_sd, found.calibration_sd))


def test_a_step_bears_the_scale_but_not_the_lift():
    upper = U > 48

    def step(xyz):
        return float(xyz[upper, 2].mean() - xyz[~upper, 2].mean())

    surface = points(np.where(upper, 0.8, -0.8))
    found = propagate(step, surface, PIXELS, uncertainty([lift, scale]), None, np.random.default_rng(1))
    assert found.calibration_sd == pytest.approx(3e-3 * 1.6, rel=1e-5)
    assert np.isnan(found.noise_sd)


def test_a_nonlinear_measurand_agrees_with_a_monte_carlo():
    """The distance of two points with errors of 1 % of it: linear to 1e-4; 4000 draws know a spread to 4.5 % (4 sd)."""
    ends = np.array([0, len(U) - 1])
    known = uncertainty([lift, scale, lambda u, v, z: (1e-4 * u, 5e-5 * v, 0 * z)])
    surface = points(np.linspace(-0.9, 0.9, len(U)))

    def distance(xyz):
        return float(np.linalg.norm(xyz[1] - xyz[0]))

    noise = np.full((2, 3), 2e-3)
    found = propagate(distance, surface[ends], PIXELS[ends], known, noise, np.random.default_rng(2))
    rng = np.random.default_rng(3)
    moves = known.displacements(PIXELS[ends], surface[ends, 2])
    draws = [
        distance(surface[ends] + moves @ rng.standard_normal(moves.shape[-1]) + rng.standard_normal((2, 1)) * noise)
        for _ in range(4000)
    ]
    expected = np.std(draws)
    exact = np.hypot(
        found.calibration_sd, np.sqrt(2) * 2e-3 * abs(np.sum(np.diff(surface[ends], axis=0))) / found.value
    )
    assert exact == pytest.approx(expected, rel=4 / np.sqrt(2 * 4000))
    assert found.sd == pytest.approx(exact, rel=0.1)


def test_a_pattern_of_single_pixels_averages_out_but_belongs_to_the_calibration():
    found = propagate(mean_height, points(0.0), PIXELS, uncertainty([], pattern=2e-3), None, np.random.default_rng(4))
    assert found.calibration_sd == pytest.approx(2e-3 / np.sqrt(len(U)), rel=4 / np.sqrt(2 * 200))


def test_of_a_map_the_valid_points_that_are_asked_for_count():
    z = np.full((80, 100), 0.5)
    z[:, 50:] = 0.7
    z[3, 4] = np.nan
    v, u = np.mgrid[:80, :100]
    surface = PointMap(np.stack([0.01 * u, 0.01 * v, z], axis=-1), np.full((80, 100, 3), 1e-3), uncertainty([lift]))
    found = estimate(mean_height, surface, u < 50, np.random.default_rng(1))
    assert found.value == pytest.approx(0.5)
    assert found.calibration_sd == pytest.approx(2e-3, rel=1e-5)
    assert found.noise_sd == pytest.approx(1e-3 / np.sqrt(3999), rel=4 / np.sqrt(2 * 200))
    with pytest.raises(ValueError, match="made without uncertainties"):
        estimate(mean_height, PointMap(surface.xyz), u < 50, np.random.default_rng(1))


def test_an_interval_holds_its_level_of_a_normal_distribution():
    estimate = Estimate(1.0, 3.0, 4.0)
    low, high = estimate.interval(0.95)
    assert norm.cdf((high - 1.0) / 5.0) - norm.cdf((low - 1.0) / 5.0) == pytest.approx(0.95)
