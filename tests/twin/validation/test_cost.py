"""The figures of one line, from planes whose errors are known."""

import numpy as np
import pytest

from greenough.twin.validation.cost import PlaneSeen, cost_of

HEIGHTS = np.array([-1.2, -0.6, 0.0, 0.6, 1.2])


def seen(errors: np.ndarray, expected: float = 0.0, structure: float = 0.0, noise: float = 0.0) -> PlaneSeen:
    return PlaneSeen(errors, structure, noise, np.full(4, expected))


def test_systematic_errors_are_told_from_noise():
    """Two exposures share a tilt and an offset; 5 x 20 000 normal deviates fix their spread to 1 %."""
    rng = np.random.default_rng(3)
    tilt = np.linspace(-1, 1, 200) * np.sqrt(3) * 0.4  # 0.4 um RMS
    offsets = np.array([-1.0, -0.5, 0.0, 0.5, 2.0])
    pairs = [o + tilt + rng.normal(0, 1.5, (2, 100, 200)) for o in offsets]
    for pair in pairs:
        pair[:, :3] = np.nan
    cost = cost_of("paper", [seen(pair) for pair in pairs])
    assert cost.noise_um == pytest.approx(1.5, rel=0.02)
    assert cost.flatness_um == pytest.approx(0.4, rel=0.1)
    assert cost.systematic_um == pytest.approx(np.sqrt(np.mean(offsets**2) + 0.16), rel=0.05)
    assert cost.bias_um == pytest.approx(0.2, abs=0.03)
    assert cost.step_um == pytest.approx(3.0, abs=0.06)


def test_an_error_of_scale_is_a_step_without_bias():
    planes = [seen(np.full((2, 4, 5), -0.5 * z), expected=-0.5 * z) for z in HEIGHTS]
    cost = cost_of("bundle", planes)
    assert cost.bias_um == pytest.approx(0)
    for step, systematic in (
        (cost.step_um, cost.systematic_um),
        (cost.step_predicted_um, cost.systematic_predicted_um),
    ):
        assert step == pytest.approx(-1.2)
        assert systematic == pytest.approx(0.5 * np.sqrt(np.mean(HEIGHTS**2)))
    assert cost.flatness_um == pytest.approx(0, abs=1e-12)
    assert cost.noise_um == 0


def test_a_plane_that_was_not_measured_leaves_no_figure_that_looks_good():
    planes = [seen(np.full((2, 4, 5), 1.0), structure=0.1, noise=0.1) for _ in HEIGHTS]
    planes[2] = seen(np.full((2, 4, 5), np.nan), structure=float("nan"), noise=0.1)
    cost = cost_of("bundle", planes)
    for figure in (cost.bias_um, cost.systematic_um, cost.flatness_um, cost.structure_um, cost.noise_um):
        assert np.isnan(figure)
    assert cost.step_um == 0  # of the outermost


def test_what_is_predicted_and_structure_are_root_mean_squares_over_the_heights():
    planes = [seen(np.zeros((2, 4, 5)), structure=s, noise=2 * s) for s in (0.0, 3.0, 4.0, 0.0, 0.0)]
    cost = cost_of("paper", planes)
    assert cost.structure_um == pytest.approx(np.sqrt(5))
    assert cost.noise_predicted_um == pytest.approx(2 * np.sqrt(5))
