"""Claims about the order of frames: which stand wrongly is said, and sound ones are never blamed."""

import numpy as np
import pytest

from greenough.pipeline.diagnosis.finding import Yardstick
from greenough.pipeline.diagnosis.swapped_frames import candidate_orders, find_order, order_finding, rearranged
from greenough.pipeline.fringes import FringeSet


def exchanged(stack, first, second):
    stack = stack.copy()
    stack[[first, second]] = stack[[second, first]]
    return stack


@pytest.mark.parametrize("pair", [(0, 2), (1, 3), (4, 5), (8, 10), (12, 13), (14, 20), (3, 12), (2, 7)])
def test_two_exchanged_frames_are_named_within_a_set_and_across_sets(taken, paint, pair):
    order = find_order(taken(exchanged(paint(), *pair)))
    assert order is not None
    assert order.text == f"frames {pair[0]} and {pair[1]} are exchanged"


def test_putting_them_in_order_gives_the_frames_as_they_were(taken, paint):
    stack = paint()
    sequence = taken(exchanged(stack, 5, 14))
    repaired = rearranged(sequence, find_order(sequence))
    assert repaired is not None
    np.testing.assert_array_equal(repaired.frames.stack, stack)


def test_a_repeated_and_a_dropped_frame_are_named_and_cannot_be_put_right(taken, paint):
    stack = paint()
    late = stack[[*range(10), *range(9, 23)]]
    early = np.concatenate([stack[:6], stack[7:], stack[:1]])
    for frames, text in ((late, "frame 10 repeats frame 9"), (early, "frame 6 was dropped")):
        sequence = taken(frames)
        order = find_order(sequence)
        assert order is not None
        assert order.text.startswith(text)
        assert rearranged(sequence, order) is None


def test_sound_frames_are_in_order(taken):
    assert [find_order(taken(seed=seed)) for seed in range(10)] == [None] * 10


@pytest.mark.parametrize(
    "fault",
    [{"gamma": 1.8}, {"gains": np.random.default_rng(3).normal(1, 0.02, 24)},
     {"shifts_px": np.random.default_rng(4).normal(0, 0.05, 24)}],
)  # fmt: skip
def test_other_faults_are_not_taken_for_a_wrong_order(taken, fault):
    assert find_order(taken(**fault)) is None


def test_sets_of_three_frames_leave_nothing_over_and_yet_their_phases_tell(taken, paint):
    fringes = FringeSet((608, 152, 40), (3, 3, 3))
    order = find_order(taken(exchanged(paint(fringes), 4, 5), fringes))
    assert order is not None
    assert order.text == "frames 4 and 5 are exchanged"


def test_the_effect_counts_lost_pixels_as_a_fringe(taken, paint):
    sequence = taken(exchanged(paint(), 4, 6))
    order = find_order(sequence)
    assert order is not None
    finding = order_finding(sequence, order, Yardstick(163.0))
    assert finding.effect_rad > 1  # the fringes of a wide set run backwards: orders are lost
    assert finding.effect_um == pytest.approx(163 * finding.effect_rad)
    assert finding.evidence["lost_share"] > 0.5


def test_every_pair_is_tried():
    assert sum("exchanged" in order.text for order in candidate_orders(24)) == 24 * 23 // 2
