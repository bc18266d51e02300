"""Claims about the structure estimator, on synthetic maps of known structure."""

import numpy as np
import pytest

from greenough.twin.validation.planes import BLOCK_PX
from greenough.twin.validation.structure import common_structure, structure

SHAPE = (960, 1280)
BLOCKS = SHAPE[0] * SHAPE[1] // BLOCK_PX**2
NOISE_UM = 1.7


def stripes(rms: float, period_px: float) -> np.ndarray:
    """A wave along the columns, which the blocks resolve if it is long."""
    return rms * np.sqrt(2) * np.sin(2 * np.pi * np.arange(SHAPE[1]) / period_px) * np.ones((SHAPE[0], 1))


def noise(seed: int, sigma: float | np.ndarray = NOISE_UM) -> np.ndarray:
    values = sigma * np.random.default_rng(seed).standard_normal(SHAPE)
    values[:3, :100] = np.nan
    return values


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_white_noise_has_no_structure_even_if_it_varies_over_the_picture(seed):
    """The squares' estimate has the standard deviation √(2 / blocks) σ²/n: its root exceeds 2.2 of its roots, that is
    4.7 standard deviations, once in 10^6."""
    sigma = np.linspace(1.2, 2.2, SHAPE[1])
    mean_square = np.mean(sigma**4) ** 0.5
    limit = 2.2 * np.sqrt(np.sqrt(2 / BLOCKS) * mean_square) / BLOCK_PX
    assert structure(noise(seed, sigma)) < limit
    assert limit < 0.05


def test_squares_are_unbiased_where_structure_is_far_below_the_noise_of_the_blocks():
    """40 000 blocks whose structure is a third of their noise. The estimate's square must be the truth within 4 of its
    standard deviations: 1 in 16 000 false alarms. Without the noise's share taken out it would be 13 times too large.
    """
    rng = np.random.default_rng(5)
    offsets = rng.normal(0, 0.03, (200, 200))
    offsets *= 0.03 / np.sqrt(np.mean(offsets**2))
    image = np.repeat(np.repeat(offsets, BLOCK_PX, axis=0), BLOCK_PX, axis=1).astype(np.float32)
    image += NOISE_UM * rng.standard_normal(image.shape, dtype=np.float32)
    share = (NOISE_UM / BLOCK_PX) ** 2
    error = np.sqrt((2 * share**2 + 4 * share * 0.03**2) / offsets.size)
    assert structure(image) ** 2 == pytest.approx(0.03**2, abs=4 * error)


@pytest.mark.parametrize("period_px", [160, 640])
def test_structure_longer_than_a_block_is_found_at_its_size(period_px):
    seen = 0.3 * np.sinc(BLOCK_PX / period_px)  # what the mean over a block leaves of it
    assert structure(noise(6) + stripes(0.3, period_px)) == pytest.approx(seen, rel=0.05)


@pytest.mark.filterwarnings("error")
def test_where_nothing_is_measured_nothing_is_known():
    """Not 0, which would keep to any limit. Less than half of a block is measured, or no block of both maps."""
    sparse = np.full((64, 64), np.nan)
    sparse[::16, ::16] = 1.0
    assert np.isnan(structure(sparse))
    left, right = np.full((2, 64, 64), np.nan)
    left[:, :32] = right[:, 32:] = 1.0
    assert structure(left) > 0.9
    assert np.isnan(common_structure(left, right))


def test_two_exposures_share_what_lasts_and_nothing_else():
    """The mean product of two independent maps' block means has the standard deviation σ²/n / √blocks."""
    fading = stripes(0.3, 320)
    limit = 2.2 * np.sqrt(1 / np.sqrt(BLOCKS)) * NOISE_UM / BLOCK_PX
    assert common_structure(noise(7), noise(8)) < limit
    assert common_structure(noise(7) + fading, noise(8)) < limit + 0.05
    both = noise(7) + fading, noise(8) + fading
    assert common_structure(*both) == pytest.approx(0.3 * np.sinc(BLOCK_PX / 320), rel=0.05)
