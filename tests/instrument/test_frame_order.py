"""Frames are put in the order that their names tell, and the reason is said."""

import random
import re

import pytest

from greenough.instrument.errors import InputError
from greenough.instrument.frame_order import guess_order, selected

PERIODS, STEPS = (608, 152, 40, 12), (4, 4, 4, 12)


def names_by(pattern):
    """Names in the true order of periods and steps."""
    return [
        pattern(k, period, n)
        for k, (period, steps) in enumerate(zip(PERIODS, STEPS, strict=True))
        for n in range(steps)
    ]


@pytest.mark.parametrize(
    ("pattern", "says"),
    [
        (lambda k, period, n: f"freq{k}_step{n}.png", "first number.*'freq'.*counts periods"),
        (lambda k, period, n: f"step{n}_freq{k}.png", "second number.*counts periods"),
        (lambda k, period, n: f"p{period}_{n:02}.tif", "first number.*'p'.*counts periods"),
        (lambda k, period, n: f"run7_shift{n + 1}_set{k + 1}.png", "second number.*counts periods"),
    ],
)
def test_two_numbers_tell_period_and_step_in_any_order_of_the_files(pattern, says):
    true = names_by(pattern)
    for seed in range(5):
        shuffled = random.Random(seed).sample(true, len(true))
        order, reason = guess_order(shuffled, PERIODS, STEPS)
        assert [shuffled[k] for k in order] == true
        assert re.search(says, reason)


def test_equal_counts_are_told_by_their_words():
    true = [f"phase{n}-period{k}.png" for k in range(3) for n in range(3)]
    order, _ = guess_order(sorted(true), (90, 30, 10), (3, 3, 3))
    assert [sorted(true)[k] for k in order] == true


def test_letters_put_ten_before_two_and_that_is_mended():
    true = [f"frame{n}.png" for n in range(24)]
    order, reason = guess_order(sorted(true), PERIODS, STEPS)
    assert [sorted(true)[k] for k in order] == true
    assert reason == "numbers in the names"


def test_an_order_that_somebody_chose_is_kept():
    chosen = [f"frame{n}.png" for n in reversed(range(24))]
    assert guess_order(chosen, PERIODS, STEPS) == (list(range(24)), "the order of the files")
    assert guess_order(["a", "b", "c"], (10,), (3,)) == ([0, 1, 2], "the order of the files")


def test_ranges_of_frames():
    assert selected("3-5, 0-2,9", 10, "--x") == [3, 4, 5, 0, 1, 2, 9]
    assert selected("5-3", 10, "--x") == [5, 4, 3]
    for text in ("", "a", "1-", "-1", "1--2", "10", "0-9999999"):
        with pytest.raises(InputError, match="--x"):
            selected(text, 10, "--x")
