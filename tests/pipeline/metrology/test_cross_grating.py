"""Gratings that are measured with known errors."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from greenough.instrument.errors import InputError
from greenough.pipeline.metrology.cross_grating import in_plane, mapping_deviation

GRATING = np.stack(np.meshgrid(np.arange(-5, 6) * 0.5, np.arange(-4, 5) * 0.5), axis=-1).reshape(-1, 2)


def turned(angle: float) -> np.ndarray:
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


def test_a_grating_that_lies_turned_and_scaled_has_no_deviation():
    found = mapping_deviation(1.002 * GRATING @ turned(2.5).T + [7, -3], GRATING)
    assert found.scale == pytest.approx(1.002)
    assert found.rotation == pytest.approx(2.5)
    assert found.largest < 1e-12
    assert (found.alpha_x, found.alpha_y) == pytest.approx((1.002, 1.002))
    assert found.squareness == pytest.approx(0.0, abs=1e-12)
    assert (found.n, found.of) == (99, 99)


@pytest.mark.parametrize("angle", [0.0, 0.6, np.pi / 2, 3.0])
def test_unequal_scales_and_skew_are_the_instruments_however_the_grating_lies(angle):
    """x too long by 1 and y too short by 2 per mille; each axis 1.5 mrad off, to first order."""
    instrument = np.array([[1.001, -1.5e-3], [-1.5e-3, 0.998]])
    found = mapping_deviation(GRATING @ turned(angle).T @ instrument.T, GRATING)
    assert found.alpha_x == pytest.approx(1.001, abs=1e-9)
    assert found.alpha_y == pytest.approx(0.998, abs=1e-9)
    assert found.squareness == pytest.approx(3e-3, abs=1e-5)
    assert found.largest > 1e-3


def test_a_general_optimiser_finds_the_same_similarity():
    rng = np.random.default_rng(2)
    measured = 0.99 * GRATING @ turned(0.3).T + [1, 2] + 0.01 * rng.standard_normal(GRATING.shape)
    found = mapping_deviation(measured, GRATING)

    def residual(at: np.ndarray) -> np.ndarray:
        return (measured - at[0] * GRATING @ turned(at[1]).T - at[2:]).ravel()

    best = least_squares(residual, [1, 0, 0, 0], xtol=1e-14, ftol=1e-14, gtol=1e-14)
    assert (found.scale, found.rotation) == pytest.approx(best.x[:2], abs=1e-8)
    np.testing.assert_allclose(found.deviations.ravel(), best.fun, atol=1e-8)
    assert found.rms == pytest.approx(np.sqrt(2 * np.mean(best.fun**2)))


@settings(max_examples=40)
@given(
    angle=st.floats(-3, 3), shift=st.tuples(st.floats(-50, 50), st.floats(-50, 50)), scale=st.floats(0.1, 10),
    seed=st.integers(0, 2**32 - 1),
)  # fmt: skip
def test_deviations_do_not_depend_on_how_the_grating_lies_or_its_marks_order(angle, shift, scale, seed):
    """Turning the certified frame turns nothing in the instrument's; scaling everything scales the deviations."""
    rng = np.random.default_rng(seed)
    measured = GRATING + 0.01 * rng.standard_normal(GRATING.shape)
    order = rng.permutation(len(GRATING))
    plain = mapping_deviation(measured, GRATING)
    other = mapping_deviation(scale * measured[order] + shift, scale * (GRATING @ turned(angle).T)[order] - shift)
    np.testing.assert_allclose(other.deviations, scale * plain.deviations[order], atol=1e-9)
    for name in ("scale", "alpha_x", "alpha_y", "squareness"):
        assert getattr(other, name) == pytest.approx(getattr(plain, name), abs=1e-9)


def test_scatter_of_scale_and_rms_are_those_of_the_marks_noise():
    """Of 1000 gratings. sd(scale) = sd(rotation) = σ / sqrt(Σ|c|²); Σ deviations² / σ² is chi2 with 2 n - 4.

    Variances within chi2's limits at 1e-5, means within 4.5 sd; alpha_x alone has σ / sqrt(Σ x²).
    """
    rng, repeats, sigma = np.random.default_rng(3), 1000, 1e-3
    found = [mapping_deviation(GRATING + sigma * rng.standard_normal((99, 2)), GRATING) for _ in range(repeats)]
    low, high = chi2.ppf([0.5e-5, 1 - 0.5e-5], repeats - 1) / (repeats - 1)
    all_of, x, y = np.sum(GRATING**2), np.sum(GRATING[:, 0] ** 2), np.sum(GRATING[:, 1] ** 2)
    for name, true, size in (("scale", 1, all_of), ("rotation", 0, all_of), ("alpha_x", 1, x), ("alpha_y", 1, y)):
        values, sd = np.array([getattr(f, name) for f in found]), sigma / np.sqrt(size)
        assert low < values.var(ddof=1) / sd**2 < high
        assert abs(values.mean() - true) < 4.5 * sd / np.sqrt(repeats)
    squares = np.array([99 * f.rms**2 for f in found]) / sigma**2
    assert abs(squares.mean() - 194) < 4.5 * np.sqrt(2 * 194 / repeats)


@pytest.mark.parametrize("angle", [0.0, np.pi / 2])
def test_stated_deviations_of_stretch_and_squareness_are_those_of_repeats(angle):
    """Of 1000 gratings by an instrument that is stretched and skewed, which is no scatter.

    Variances within chi2's limits at 1e-5; the stated ones, each of 192 degrees of freedom, average to a per cent.
    """
    rng, repeats = np.random.default_rng(4), 1000
    instrument = np.array([[1.01, -5e-3], [-5e-3, 0.99]])
    lying = GRATING @ turned(angle).T @ instrument.T
    found = [mapping_deviation(lying + 1e-3 * rng.standard_normal((99, 2)), GRATING) for _ in range(repeats)]
    low, high = chi2.ppf([0.5e-5, 1 - 0.5e-5], repeats - 1) / (repeats - 1)
    for name in ("alpha_x", "alpha_y", "squareness"):
        values = np.array([getattr(f, name) for f in found])
        stated = np.mean([getattr(f, f"{name}_sd") ** 2 for f in found])
        assert 0.98 * low < values.var(ddof=1) / stated < 1.02 * high, name


def test_marks_that_were_not_measured_are_left_out_and_counted():
    measured = GRATING + np.array([3, 4])
    measured[[5, 60]] = np.nan
    found = mapping_deviation(measured, GRATING)
    assert (found.n, found.of) == (97, 99)
    assert np.isnan(found.deviations[5]).all()
    assert found.largest < 1e-12


def test_a_tilted_grating_is_measured_in_its_own_plane():
    tilt = Rotation.from_rotvec([0.3, -0.2, 0.0])
    points = tilt.apply(np.column_stack([GRATING, np.zeros(99)])) + np.array([1, 2, 3])
    points[7] = np.nan
    flat = in_plane(points)
    assert np.isnan(flat[7]).all()
    found = mapping_deviation(flat, GRATING)
    assert found.scale == pytest.approx(1.0)
    assert found.rotation == pytest.approx(0.0, abs=1e-9)  # the shortest way back turns about the same axis
    assert found.largest < 1e-12


def test_marks_that_cannot_be_mapped_are_told():
    for measured, certified, told in (
        (GRATING[:5], GRATING[:5], "at least 6"),
        (GRATING, GRATING[:-1], "shapes"),
        (GRATING[:11], GRATING[:11], "one line"),
    ):
        with pytest.raises(InputError, match=told):
            mapping_deviation(measured, certified)
