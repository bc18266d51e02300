"""Claims about the test for white noise: its false alarms on noise, and what it finds in it."""

import numpy as np
import pytest

from greenough.twin.validation.whiteness import LAGS, SCALES_PX, detectable, whiteness

SHAPE = (240, 320)
FALSE_ALARMS = 0.01


def noise(rng: np.random.Generator, sigma: np.ndarray | float = 1.0) -> np.ndarray:
    """White, with a border that is not measured and some pixels missing."""
    values = sigma * rng.standard_normal(SHAPE)
    values[:5] = values[:, -7:] = np.nan
    values[rng.random(SHAPE) < 0.02] = np.nan
    return values


def block_structure(rng: np.random.Generator, rms: float, side: int) -> np.ndarray:
    """Random heights of squares of twice ``side``, so that half of the blocks of ``side`` are like their neighbour."""
    coarse = rng.standard_normal((SHAPE[0] // (2 * side) + 1, SHAPE[1] // (2 * side) + 1))
    fine = np.repeat(np.repeat(coarse, 2 * side, axis=0), 2 * side, axis=1)[: SHAPE[0], : SHAPE[1]]
    return rms * fine / np.sqrt(np.mean(fine**2))


def test_false_alarms_are_as_rare_as_stated_whatever_the_noise_does_over_the_picture():
    """300 maps at a p-value of 0.01 give 3 alarms; 11 or more come once in 3000 runs of the test. The p-value bounds
    the probability from above, so that there may be fewer."""
    rng = np.random.default_rng(1)
    sigma = np.linspace(0.5, 2.0, SHAPE[1]) * np.ones((SHAPE[0], 1))
    alarms = sum(whiteness(noise(rng, sigma), sigma).p_value < FALSE_ALARMS for _ in range(300))
    assert alarms <= 10


def test_scores_are_standard_normal_under_noise():
    """Over 300 maps the variance of each score is known to √(2 / 300) = 8 %: 5 of them for any of 24 scores. The mean
    departs by the plane's degrees of freedom alone, of which nothing is taken out here."""
    rng = np.random.default_rng(2)
    scores = np.array([whiteness(noise(rng), np.ones(SHAPE)).scores for _ in range(300)])
    assert scores.shape[1:] == (len(SCALES_PX), len(LAGS))
    np.testing.assert_allclose(scores.var(axis=0), 1, atol=0.42)
    np.testing.assert_allclose(scores.mean(axis=0), 0, atol=5 / np.sqrt(300))


@pytest.mark.parametrize("side", [1, 4, 16])
def test_structure_above_what_is_said_to_be_detectable_is_found_and_far_below_it_is_not(side):
    """Twice the detectable RMS has 4 times its score over half of the pairs: twice the score that raises an alarm. A
    third has a ninth of it."""
    rng = np.random.default_rng(3)
    size = detectable(1.0, SHAPE[0] * SHAPE[1], side, FALSE_ALARMS)
    found = [whiteness(noise(rng) + block_structure(rng, 2 * size, side), np.ones(SHAPE)).p_value for _ in range(20)]
    assert np.mean(np.array(found) < FALSE_ALARMS) > 0.7
    missed = [whiteness(noise(rng) + block_structure(rng, size / 3, side), np.ones(SHAPE)).p_value for _ in range(20)]
    assert np.mean(np.array(missed) < FALSE_ALARMS) < 0.3


def test_neighbours_that_share_noise_are_found():
    rng = np.random.default_rng(4)
    white = noise(rng)
    filtered = white[:, 1:] + 0.05 * white[:, :-1]
    assert whiteness(filtered, np.ones(filtered.shape)).p_value < 1e-6
    assert whiteness(filtered, np.ones(filtered.shape)).correlations[0, 0] == pytest.approx(0.05, abs=0.02)
