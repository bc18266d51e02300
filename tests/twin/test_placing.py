"""Claims about how parts come to lie on the table."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import chi2

from greenough.instrument.rigfile import load_rig_file
from greenough.twin.placing import DEPTH_MM, SHIFT_MM, TILT_DEG, flat, lifted, on_wedge, tilted

FALSE_ALARM = 1e-6
SPOTS = load_rig_file("twin").board.nominal.centres()

seeds = st.integers(0, 2**32 - 1)
postures = st.integers(0, 199)


def spots_on_table(motion: np.ndarray) -> np.ndarray:
    return np.column_stack([SPOTS, np.zeros(len(SPOTS))]) @ motion[:3, :3].T + motion[:3, 3]


@settings(max_examples=30)
@given(seeds, postures)
def test_a_posture_is_the_same_every_time_and_rigid(seed, posture):
    motion = tilted(seed, posture, SPOTS)
    np.testing.assert_array_equal(motion, tilted(seed, posture, SPOTS))
    np.testing.assert_allclose(motion[:3, :3] @ motion[:3, :3].T, np.eye(3), atol=1e-12)
    assert motion[2, 2] > 0  # printed face up


@settings(max_examples=30)
@given(seeds, postures)
def test_no_spot_of_a_posture_leaves_the_depth_of_field(seed, posture):
    heights = spots_on_table(tilted(seed, posture, SPOTS))[:, 2]
    assert np.abs(heights).max() <= DEPTH_MM + 1e-9


@settings(max_examples=30)
@given(seeds, postures)
def test_a_posture_tilts_and_shifts_within_its_bounds(seed, posture):
    motion = tilted(seed, posture, SPOTS)
    tilt = np.degrees(np.arccos(motion[2, 2]))
    reach = np.abs(SPOTS).max()
    least = np.degrees(np.arcsin(DEPTH_MM / np.hypot(reach, reach)))
    assert min(TILT_DEG[0], least) <= tilt <= TILT_DEG[1]
    assert np.abs(motion[0, 3]) <= SHIFT_MM[0]
    assert np.abs(motion[1, 3]) <= SHIFT_MM[1]


@settings(max_examples=30)
@given(seeds)
def test_slopes_of_sixteen_postures_go_all_round(seed):
    normals = np.stack([tilted(seed, posture, SPOTS)[:3, 2] for posture in range(16)])
    direction = np.sort(np.arctan2(normals[:, 1], normals[:, 0]))
    gaps = np.diff(np.append(direction, direction[0] + 2 * np.pi))
    assert gaps.max() < 1.5 * 2 * np.pi / 16


@settings(max_examples=30)
@given(seeds, postures)
def test_other_postures_and_other_instruments_lie_differently(seed, posture):
    motion = tilted(seed, posture, SPOTS)
    assert not np.allclose(motion, tilted(seed, posture + 1, SPOTS), atol=1e-6)
    assert not np.allclose(motion, tilted(seed ^ 1, posture, SPOTS), atol=1e-6)


@settings(max_examples=30)
@given(seeds, st.text(max_size=20))
def test_what_lies_flat_is_parallel_to_the_table_at_its_height(seed, what):
    motion = flat(seed, what)
    np.testing.assert_allclose(motion[2], [0, 0, 1, 0], atol=1e-15)
    np.testing.assert_allclose(motion[:3, 2], [0, 0, 1], atol=1e-15)
    np.testing.assert_array_equal(motion, flat(seed, what))


def test_a_hand_misses_by_a_tenth_of_a_millimetre_and_a_degree():
    motions = np.stack([flat(seed, "coin") for seed in range(500)])
    turns = np.degrees(np.arctan2(motions[:, 1, 0], motions[:, 0, 0]))
    low, high = chi2.ppf([FALSE_ALARM / 4, 1 - FALSE_ALARM / 4], [[500], [1000]]).T
    assert low[0] < np.sum(turns**2) < high[0]
    assert low[1] < np.sum((motions[:, :2, 3] / 0.1) ** 2) < high[1]


@settings(max_examples=30)
@given(st.floats(-1e-3, 1e-3), st.floats(-1e-3, 1e-3))
def test_a_board_on_its_blank_face_slopes_as_it_gets_thicker(gx, gy):
    heights = spots_on_table(on_wedge(np.array([gx, gy])))[:, 2]
    np.testing.assert_allclose(heights, SPOTS @ [gx, gy], atol=1e-8)


@pytest.mark.parametrize("height", [0.0, 1e-3, -0.2])
def test_lifting_only_lifts(height):
    np.testing.assert_allclose(spots_on_table(lifted(height)), np.column_stack([SPOTS, np.full(len(SPOTS), height)]))
