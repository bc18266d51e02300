from math import cos, pi

import numpy as np
import pytest

from greenough.instrument.errors import InputError
from greenough.pipeline.fringes import PAPER, FringeSet


def test_paper_set_has_the_ratios_of_table_1():
    np.testing.assert_allclose(PAPER.ratios, (1, 4, 3.8, 3.33), atol=0.005)
    assert PAPER.frame_count == 24
    assert PAPER.periods[0] / PAPER.periods[-1] == pytest.approx(50.67, abs=0.005)


def test_patterns_follow_equation_1():
    patterns = PAPER.patterns(3, 608)
    assert patterns.shape == (24, 3, 608)
    assert patterns.dtype == np.uint8
    for period, steps, part in zip(PAPER.periods, PAPER.steps, PAPER.slices, strict=True):
        for n, pattern in enumerate(patterns[part]):
            for x in (0, 1, 77, 303, 607):
                exact = 127.5 + 127.5 * cos(2 * pi * x / period + 2 * pi * n / steps)
                assert np.abs(pattern[:, x] - exact).max() <= 0.5 + 1e-9


def test_patterns_are_the_same_in_every_period():
    patterns = PAPER.patterns(1, 608)
    for period, part in zip((608, 152, 40, 12), PAPER.slices, strict=True):
        np.testing.assert_array_equal(patterns[part], patterns[part][:, :, np.arange(608) % period])


def test_slices_cut_the_stack_into_the_sets_in_turn():
    frames = list(range(PAPER.frame_count))
    assert [len(frames[part]) for part in PAPER.slices] == list(PAPER.steps)
    assert [frame for part in PAPER.slices for frame in frames[part]] == frames


@pytest.mark.parametrize(
    ("periods", "steps", "says"),
    [
        ((), (), "at least one period"),
        ((608, 152), (4,), "one number of steps for each period"),
        ((152, 608), (4, 4), "must decrease"),
        ((608, 608), (4, 4), "must decrease"),
        ((608, 1.5), (4, 4), "longer than 2 columns"),
        ((float("inf"), 12), (4, 4), "finite"),
        ((608, 152), (4, 2), "at least 3"),
        ((608, 152), (4, 4.5), "whole numbers"),
    ],
)
def test_a_set_that_cannot_be_decoded_is_refused(periods, steps, says):
    with pytest.raises(InputError, match=says):
        FringeSet(periods, steps)


def test_a_projector_wider_than_the_coarsest_period_is_refused():
    with pytest.raises(InputError, match="all 609 columns"):
        PAPER.patterns(2, 609)
