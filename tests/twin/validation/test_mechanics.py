"""Claims about what stage and board as built do to heights: shapes that a fit per place takes for flat."""

import numpy as np
import pytest

from greenough.twin.validation.mechanics import field_grid, flatness_error, percentile_with_noise, systematic_error

READINGS = np.linspace(-1.45, 1.45, 30)
HEIGHTS = np.array([-1.2, 0.0, 0.9])


def error_of(analytic, blank_face_height) -> np.ndarray:
    return systematic_error(analytic(blank_face_height=blank_face_height).bench, READINGS, HEIGHTS)


def test_an_ideal_stage_and_board_make_no_error(analytic):
    np.testing.assert_allclose(error_of(analytic, lambda z, xy: np.full(len(xy), z)), 0, atol=1e-12)


def test_the_blank_face_s_shape_comes_back_with_the_opposite_sign(analytic):
    def shape(xy):
        return 1e-3 * (0.3 * xy[:, 0] + 0.1 * xy[:, 1] ** 2)

    error = error_of(analytic, lambda z, xy: z + shape(xy))
    np.testing.assert_allclose(error, np.tile(-shape(field_grid()), (3, 1)), atol=1e-9)


def test_a_stage_that_goes_too_far_makes_heights_too_small(analytic):
    error = error_of(analytic, lambda z, xy: np.full(len(xy), 1.001 * z))
    np.testing.assert_allclose(error, np.tile((HEIGHTS * (1 / 1.001 - 1))[:, None], len(field_grid())), atol=1e-9)


def test_flatness_ignores_height_and_tilt():
    grid = field_grid()
    tilt = 0.01 + 0.02 * grid[:, 0] - 0.03 * grid[:, 1]
    assert flatness_error(tilt) == pytest.approx(0, abs=1e-12)
    ripple = 1e-3 * np.cos(np.pi * np.arange(len(grid)))  # neither constant nor linear over the symmetric grid
    assert flatness_error(tilt + ripple) == pytest.approx(1e-3, rel=0.01)


def test_percentile_with_noise_is_the_folded_normal_s_about_a_bias():
    # 199 deviates stand for the normal distribution: between 0.945 and 0.955, so to 3 %.
    assert percentile_with_noise(np.zeros(100), 1e-3, 0.95) == pytest.approx(1.96e-3, rel=0.03)
    assert percentile_with_noise(np.full(100, 0.1), 1e-3, 0.95) - 0.1 == pytest.approx(1.645e-3, rel=0.03)
