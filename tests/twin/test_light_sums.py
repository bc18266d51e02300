"""Claims about sums of patterns that stand for patterns that have moved. Nothing is left to chance but the seeds."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from greenough.twin.dmd import MARGIN, Mirrors, band_limited
from greenough.twin.light_sums import LARGEST_REST, RIM, as_sums

CELLS = np.arange(1600) / 4  # columns


def cosines(period: float, steps: int, shift: float = 0.0) -> np.ndarray:
    """White, and a set of fringes that have moved by ``shift`` columns: (1 + steps, cells)."""
    phase = (CELLS + shift) / period + np.arange(steps)[:, None] / steps
    return np.concatenate([np.ones((1, len(CELLS))), (1 + np.cos(2 * np.pi * phase)) / 2])


@pytest.mark.parametrize(("period", "steps"), [(12.0, 12), (40.0, 4), (33.3, 3), (400.0, 5)])
@pytest.mark.parametrize("shift", [1e-3, -0.4])
def test_a_cosine_that_moves_is_a_sum_whatever_its_phase(period, steps, shift):
    patterns, own = cosines(period, steps), np.arange(1, 1 + steps)
    moved = cosines(period, steps, shift)[1:]
    sums = as_sums(moved, own, patterns)
    assert sums.rest < 1e-9
    assert_allclose(np.einsum("nk,nkc->nc", sums.weights, patterns[sums.terms]), moved, atol=1e-9)


def test_what_has_not_moved_is_itself():
    patterns = cosines(12.0, 4)
    sums = as_sums(patterns, np.arange(5), patterns)
    assert sums.rest == 0
    assert (np.einsum("nk,nkc->nc", sums.weights, patterns[sums.terms]) == patterns).all()


def test_the_rest_is_the_largest_light_that_is_left():
    patterns = cosines(12.0, 4)
    bump = np.where(np.arange(len(CELLS)) == 700, 0.01, 0.0)
    moved = cosines(12.0, 4, 0.02)[1:] + bump
    sums = as_sums(moved, np.arange(1, 5), patterns)
    left = moved - np.einsum("nk,nkc->nc", sums.weights, patterns[sums.terms])
    assert sums.rest == pytest.approx(np.abs(left).max(), rel=1e-9)
    assert sums.rest > 0.009


def test_patterns_that_are_no_fringes_say_that_no_sum_makes_them():
    patterns = np.random.default_rng(3).random((7, len(CELLS)))
    moved = np.roll(patterns, 1, axis=1)
    assert as_sums(moved, np.arange(7), patterns).rest > 100 * LARGEST_REST


@pytest.mark.parametrize("seed", range(4))
def test_the_mirrors_rounded_fringes_may_move_as_far_as_vibration_moves_them(seed):
    """A hundredth of a column: 0.18 um, nearly two standard deviations of the vibration."""
    columns = np.arange(608)
    lines = [np.rint(127.5 * (1 + np.cos(2 * np.pi * (columns / 12 + n / 12)))) for n in range(12)]
    patterns = np.concatenate([np.full((1, 608), 255), lines]).astype(np.uint8)[:, None].repeat(4, axis=1)
    mirrors = Mirrors(17.835e-3, 8.923e-3, fill=0.92, off_state=0.001)
    shift = np.zeros((13, 2))
    shift[1:, 0] = np.random.default_rng(seed).uniform(-0.01, 0.01, 12)

    def light(shift: np.ndarray | None) -> np.ndarray:
        table = band_limited(patterns, mirrors, 0.015, 0.525e-3, shift)
        rim = (MARGIN + RIM) * table.cells[0]
        return table.values[0, rim:-rim].T.astype(float)

    still, moved = light(None), light(shift)
    sums = as_sums(moved, np.arange(13), still)
    assert sums.rest < LARGEST_REST < np.abs(moved - still).max()
