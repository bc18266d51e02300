import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from greenough.instrument.errors import InputError
from greenough.instrument.limits import check_patterns, check_within


@given(value=st.floats(), low=st.floats(-10, 0), high=st.floats(0, 10))
def test_exactly_the_values_outside_are_refused(value: float, low: float, high: float) -> None:
    refused = False
    try:
        check_within(value, (low, high), "stage position", "mm")
    except InputError:
        refused = True
    assert refused == (not (value >= low and value <= high))


@pytest.mark.parametrize(
    "patterns",
    [
        np.zeros((3, 5, 4), np.uint8),
        np.zeros((4, 5), np.uint8),
        np.zeros((0, 4, 5), np.uint8),
        np.zeros((3, 4, 5), np.uint16),
        np.zeros((3, 4, 5), bool),
    ],
)
def test_patterns_that_do_not_fit_are_refused_with_what_fits(patterns: np.ndarray) -> None:
    check_patterns(np.zeros((3, 4, 5), np.uint8), (4, 5))
    with pytest.raises(InputError, match=r"takes uint8 of shape \(N, 4, 5\)"):
        check_patterns(patterns, (4, 5))
