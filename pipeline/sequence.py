"""What a procedure shows in one capture, and what the frames of it say: fringes, and a Gray code if there is one."""

from dataclasses import replace

import numpy as np

from greenough.instrument.contract import CameraNoise, Frames, Procedure

from .decode import PhaseMap, decode
from .fringes import FringeSet
from .gray_code import locate, stripe_patterns
from .grey_variance import GreyVariance


def sequence_patterns(procedure: Procedure, shape: tuple[int, int]) -> np.ndarray:
    """Patterns (N, rows, cols) uint8 for a projector of ``shape``: the fringes, then the bits, the coarsest first.

    With ``procedure.gray_inverse`` each bit is followed by its inverse. Read-only: all rows share one memory.
    """
    rows, cols = shape
    fringes = FringeSet.of(procedure)
    lines = fringes.patterns(1, cols)[:, 0]
    if procedure.gray_bits:
        bits = stripe_patterns(cols, stripe_width(procedure), procedure.gray_bits)
        if procedure.gray_inverse:
            bits = np.stack([bits, 255 - bits], axis=1).reshape(-1, cols)
        lines = np.concatenate([lines, bits])
    return np.broadcast_to(lines[:, None, :], (len(lines), rows, cols))


def decode_sequence(frames: Frames, procedure: Procedure, noise: CameraNoise | GreyVariance | None = None) -> PhaseMap:
    """Decode the frames of `sequence_patterns`; raises InputError as `decode` and `locate` do."""
    fringes = FringeSet.of(procedure)
    if not procedure.gray_bits:
        return decode(frames, fringes, noise)
    stack, code = frames.stack[: fringes.frame_count], frames.stack[fringes.frame_count :]
    if procedure.gray_inverse:
        window = locate(code[::2], code[1::2], stripe_width(procedure))
    else:
        middle = stack.mean(axis=0, keepdims=True, dtype=np.float32)  # of the fringes, is that of black and white
        window = locate(code, middle, stripe_width(procedure))
    return decode(replace(frames, stack=stack), fringes, noise, window)


def stripe_width(procedure: Procedure) -> float:
    """Columns of the Gray code's stripes."""
    return procedure.gray_width_px or procedure.periods_px[-1]
