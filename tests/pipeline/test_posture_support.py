"""Heights that a cloud of spots supports, against hulls that are known in closed form."""

import itertools

import numpy as np
import pytest

from greenough.pipeline.posture_support import supported_heights

SHAPE = (60, 80)
REACH = np.array([4.0, 4.0, 0.3])


def box(low, high):
    return np.array(list(itertools.product(*zip(low, high, strict=True))), dtype=float)


def test_over_a_box_every_pixel_has_its_heights_and_the_reach_beyond():
    z_range = supported_heights(SHAPE, box((20, 15, -1.0), (60, 45, 1.2)), REACH)
    np.testing.assert_allclose(z_range[15:46, 20:61], np.broadcast_to([-1.3, 1.5], (31, 41, 2)), atol=1e-9)


def test_beyond_a_box_what_the_reach_adds_shrinks_and_ends():
    """Half a reach outside, half of what it adds to the heights is left; beyond the reach there are none."""
    z_range = supported_heights(SHAPE, box((20, 15, -1.0), (60, 45, 1.2)), REACH)
    np.testing.assert_allclose(z_range[30, 62], [-1.15, 1.35], atol=1e-9)
    np.testing.assert_allclose(z_range[13, 40], [-1.15, 1.35], atol=1e-9)
    known = np.isfinite(z_range[..., 0])
    assert known[30, 17:64].all()
    assert known[12:49, 40].all()
    assert not known[:, :16].any()
    assert not known[:, 65:].any()
    assert not known[:11].any()
    assert not known[50:].any()


def test_two_boards_tilted_against_each_other_support_a_bow_tie_filled_at_its_ends():
    """Their edges reach ±1; in the middle of the field the hull is as high as the straight line between the edges."""
    u, v = np.meshgrid(np.linspace(10, 70, 7), np.linspace(10, 50, 5))
    slope = (u - 40) / 30
    places = np.concatenate([np.column_stack([u.ravel(), v.ravel(), sign * slope.ravel()]) for sign in (1, -1)])
    z_range = supported_heights(SHAPE, places, np.array([1e-6, 1e-6, 1e-6]))
    np.testing.assert_allclose(z_range[30, 40], [-1.0, 1.0], atol=1e-5)
    np.testing.assert_allclose(z_range[30, 70], [-1.0, 1.0], atol=1e-5)
    assert np.isnan(z_range[30, 72]).all()


def test_where_no_board_reached_the_heights_follow_the_board_that_came_nearest():
    """One tilted board alone supports a slab about itself, a reach of each axis thick."""
    u, v = np.meshgrid(np.linspace(10, 70, 7), np.linspace(10, 50, 5))
    places = np.column_stack([u.ravel(), v.ravel(), (u.ravel() - 40) / 30])
    z_range = supported_heights(SHAPE, places, REACH)
    middle = z_range.mean(axis=-1)
    assert middle[30, 55] == pytest.approx(0.5, abs=1e-6)
    np.testing.assert_allclose(np.ptp(z_range[30, 20:60], axis=-1), 0.6, atol=1e-6)  # more than the 0.27 along u


def test_every_spot_lies_within_the_heights_of_its_pixel():
    rng = np.random.default_rng(4)
    places = np.column_stack([rng.integers(5, 75, 300), rng.integers(5, 55, 300), rng.normal(0, 0.5, 300)])
    z_range = supported_heights(SHAPE, places, REACH)
    low, high = z_range[places[:, 1].astype(int), places[:, 0].astype(int)].T
    assert np.all((low < places[:, 2]) & (places[:, 2] < high))
