"""One capture of a procedure: what is shown, and what comes back."""

import numpy as np
import pytest

from greenough.instrument.contract import Frames, Procedure
from greenough.pipeline.fringes import FringeSet
from greenough.pipeline.sequence import decode_sequence, sequence_patterns


def seen(procedure: Procedure) -> tuple[np.ndarray, np.ndarray]:
    """Columns that a camera sees in 4 x 600 pixels, between mirrors too, and the frames of them."""
    column = np.tile(np.linspace(4, 603, 600), (4, 1))
    patterns = sequence_patterns(procedure, (4, 608))[:, 0].astype(float)
    stack = np.stack([np.interp(column, np.arange(608), line) for line in patterns])
    return column, np.rint(20 + 0.8 * stack).astype(np.uint8)


def frames(stack: np.ndarray) -> Frames:
    serials = np.arange(len(stack))
    return Frames(stack, 255.0, 0.0, 1.0, 0.0, 0.0, serials, serials / 30.0)


@pytest.mark.parametrize(
    "coded",
    [
        {"gray_bits": 5},
        {"gray_bits": 5, "gray_inverse": True},
        {"gray_bits": 6, "gray_width_px": 10.0, "gray_inverse": True},
    ],
)
def test_a_gray_code_gives_every_column_its_order(coded):
    procedure = Procedure((20.0,), (8,), 8, 10, 0.3, 0.8, field_px=608.0, start_rad=0.4, sign=-1, **coded)
    column, stack = seen(procedure)
    bits = procedure.gray_bits * (2 if procedure.gray_inverse else 1)
    assert len(stack) == 8 + bits
    assert procedure.exposures == 18 * len(stack)
    phase_map = decode_sequence(frames(stack), procedure)
    assert phase_map.exposures == len(stack)
    assert phase_map.valid.mean() > 0.99
    error = phase_map.absolute * 20 / (2 * np.pi) - column
    assert np.abs(error[phase_map.valid]).max() < 0.1


def test_without_a_code_it_is_the_fringes_alone():
    procedure = Procedure((608.0, 40.0), (4, 6), 8, 10, 0.3, 0.8)
    np.testing.assert_array_equal(sequence_patterns(procedure, (4, 608)), FringeSet.of(procedure).patterns(4, 608))
