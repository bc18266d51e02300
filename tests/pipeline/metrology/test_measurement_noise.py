"""N_M of synthetic maps with known noise."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from greenough.instrument.errors import InputError
from greenough.pipeline.metrology.measurement_noise import noise_by_averaging, noise_by_subtraction

SHAPE = (96, 128)
SURFACE = 0.05 * np.sin(np.arange(96)[:, None] / 7) * np.cos(np.arange(128) / 11)


def noise(rng: np.random.Generator, blur_px: float = 0.0, sigma: float = 1e-3) -> np.ndarray:
    """Noise of sd ``sigma`` with a Gaussian autocorrelation of sd √2 blur_px."""
    white = rng.standard_normal(SHAPE)
    if not blur_px:
        return sigma * white
    return sigma * gaussian_filter(white, blur_px, mode="wrap") * 2 * np.sqrt(np.pi) * blur_px


def test_equal_maps_have_no_noise_and_shifted_ones_only_a_shift():
    found = noise_by_subtraction(SURFACE, SURFACE + 0.25)
    assert found.noise < 1e-12
    assert found.mean_differences == pytest.approx((0.25,))
    assert found.surface_sq == pytest.approx(SURFACE.std())
    assert (found.n, found.share, found.maps) == (96 * 128, 1.0, 2)


def test_a_difference_of_plus_and_minus_one_is_noise_of_1_over_root_2():
    second = SURFACE + np.where(np.indices(SHAPE).sum(axis=0) % 2, 1.0, -1.0)
    assert noise_by_subtraction(SURFACE, second).noise == pytest.approx(1 / np.sqrt(2))


@pytest.mark.parametrize("blur_px", [0.0, 1.0, 2.5])
def test_noise_is_found_within_its_own_uncertainty(blur_px):
    """200 pairs: standardised errors have mean 0 and variance 1, within 4.5 and 5 of their own standard deviations."""
    rng = np.random.default_rng(7)
    found = [noise_by_subtraction(SURFACE + noise(rng, blur_px), SURFACE + noise(rng, blur_px)) for _ in range(200)]
    z = np.array([(f.noise / 1e-3 - 1) / f.relative_sd for f in found])
    assert abs(z.mean()) < 4.5 / np.sqrt(200)
    assert abs(z.var(ddof=1) - 1) < 5 * np.sqrt(2 / 199)


@pytest.mark.parametrize(("blur_px", "per_value"), [(0.0, 1.0), (1.0, 2 * np.pi), (2.5, 2 * np.pi * 2.5**2)])
def test_correlated_neighbours_count_as_fewer(blur_px, per_value):
    """Sum of the squared autocorrelation exp(-r² / 4 b²): 2 π b² pixels for each independent value.

    The estimate from one map scatters with the number of independent values, and the blurred ones lose the pairs that
    reach over the border.
    """
    rng = np.random.default_rng(8)
    found = [noise_by_subtraction(noise(rng, blur_px), noise(rng, blur_px)) for _ in range(10)]
    assert np.mean([f.n / f.n_eff for f in found]) == pytest.approx(per_value, rel=0.1)


def test_noise_that_varies_over_the_map_is_known_less_well():
    """Half the map without noise: half the values, and the kurtosis says so."""
    rng = np.random.default_rng(9)
    quiet = np.where(np.arange(128) < 64, 1e-6, 1.0)
    found = noise_by_subtraction(quiet * noise(rng), quiet * noise(rng))
    assert found.n_eff == pytest.approx(96 * 64, rel=0.1)
    assert found.noise == pytest.approx(1e-3 / np.sqrt(2), rel=0.05)


def test_averaging_two_maps_is_subtraction():
    rng = np.random.default_rng(10)
    first, second = SURFACE + noise(rng, 1.0), SURFACE + noise(rng, 1.0) + 0.1
    second[3:9, 50:80] = np.nan
    one, other = noise_by_subtraction(first, second), noise_by_averaging([first, second])
    assert other.noise == pytest.approx(one.noise, rel=1e-9)
    assert other.n_eff == pytest.approx(one.n_eff, rel=1e-9)
    assert other.surface_sq == pytest.approx(one.surface_sq, rel=1e-9)
    assert other.mean_differences == pytest.approx(one.mean_differences)
    assert (other.n, other.share, other.relative_sd) == (one.n, one.share, pytest.approx(one.relative_sd))


@pytest.mark.parametrize("blur_px", [0.0, 1.0])
def test_averaging_finds_noise_and_surface_within_the_noise_s_uncertainty(blur_px):
    """60 sets of 6 maps: as for pairs."""
    rng = np.random.default_rng(11)
    found = [noise_by_averaging([SURFACE + noise(rng, blur_px) for _ in range(6)]) for _ in range(60)]
    z = np.array([(f.noise / 1e-3 - 1) / f.relative_sd for f in found])
    assert abs(z.mean()) < 4.5 / np.sqrt(60)
    assert abs(z.var(ddof=1) - 1) < 5 * np.sqrt(2 / 59)
    assert np.mean([f.surface_sq for f in found]) == pytest.approx(SURFACE.std(), rel=1e-4)


def test_voids_in_either_map_count_in_neither_and_are_stated():
    rng = np.random.default_rng(12)
    first, second = SURFACE + noise(rng), SURFACE + noise(rng)
    first[:10], second[-20:] = np.nan, np.nan
    found = noise_by_subtraction(first, second)
    assert (found.n, found.share) == (66 * 128, 66 / 96)
    assert abs(found.noise / 1e-3 - 1) < 5 * found.relative_sd
    assert found.n_eff == pytest.approx(found.n, rel=0.1)


def test_maps_that_cannot_be_compared_are_told():
    for call, told in (
        (lambda: noise_by_averaging([SURFACE]), "two or more"),
        (lambda: noise_by_subtraction(SURFACE, SURFACE[:-1]), "one shape"),
        (lambda: noise_by_subtraction(SURFACE, np.full(SHAPE, np.nan)), "0 pixels have a height"),
    ):
        with pytest.raises(InputError, match=told):
            call()
