"""Claims about one sequence: each fault is named alone, and a fault is not found again under other names."""

import numpy as np
import pytest

from greenough.pipeline.diagnosis.finding import Yardstick, worst_first
from greenough.pipeline.diagnosis.sequences import diagnose_sequence
from greenough.pipeline.fringes import FringeSet

SCALE = Yardstick(163.0, 0.5)


def names(sequence):
    return [finding.name for finding in worst_first(diagnose_sequence(sequence, SCALE))]


def test_nothing_is_found_in_sound_frames(taken):
    assert [names(taken(seed=seed)) for seed in range(20)] == [[]] * 20


@pytest.mark.parametrize("steps", [(3, 3, 3, 3), (4, 4, 4, 4), (5, 5, 5, 5), (8, 8, 8, 8)])
def test_nothing_is_found_in_sound_frames_of_other_sets(taken, steps):
    assert names(taken(fringes=FringeSet((608, 152, 40, 12), steps))) == []
    assert names(taken(fringes=FringeSet((608, 152, 40, 12), steps, start=-np.pi / 2, sign=-1))) == []
    assert names(taken(fringes=FringeSet((70, 64, 59), steps[:3], field=608))) == []


def test_frames_in_another_order_are_one_finding(taken, paint):
    stack = paint()
    stack[[5, 17]] = stack[[17, 5]]
    assert names(taken(stack)) == ["frame order"]


def test_each_fault_of_two_is_named_the_worse_first(taken, paint):
    shifts = np.random.default_rng(1).normal(0, 0.06, 24)
    stack = paint(gamma=1.8, shifts_px=shifts)
    stack[:, 20:30, 60:70] = 255
    assert names(taken(stack)) == ["saturation", "vibration", "response"]
