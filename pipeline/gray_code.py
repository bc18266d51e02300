"""Gray code: black and white stripes whose bits count them, so that at every edge one bit changes and no other.

Where the camera blurs an edge, its bit is neither black nor white. The pixel is then on that edge, between the two
stripes that the bit tells apart, and this is what is returned: not a guess of one of them. So is a pixel beside which
the picture goes from one stripe to the next: a sharp edge may lie in either of the two pixels that it parts.
"""

import numpy as np

from greenough.instrument.errors import InputError

from .order_search import ColumnWindow

_CERTAIN = 0.4  # of a pixel's own contrast: a bit that has less may be on an edge
_LEAST_CONTRAST = 0.02  # of the brightest contrast in the picture: shadows have none
_TOLERANCE = 0.15  # of a stripe, by which edges may lie beside where they should


def stripe_patterns(cols: int, stripe_width: float, bits: int) -> np.ndarray:
    """Patterns of a Gray code, (bits, cols) of 0 and 255, the coarsest bit first."""
    stripe = (np.arange(cols) // stripe_width).astype(np.int64)
    code = stripe ^ (stripe >> 1)
    return np.stack([255 * ((code >> bit) & 1) for bit in reversed(range(bits))]).astype(np.uint8)


def locate(white: np.ndarray, black: np.ndarray, stripe_width: float) -> ColumnWindow:
    """Where each pixel is, by its stripe or by the edge that it lies on.

    Parameters
    ----------
    white : (bits, rows, cols)
        Frames of the bits, the coarsest first: bright where a bit is 1.
    black : (bits, rows, cols) or (1, rows, cols)
        What is bright where a bit is 0: the inverse frames. Or the grey value between black and white, DN.
    stripe_width : float
        Of the stripes that are counted, columns.

    Raises
    ------
    InputError
        When there are no bits or more than 30, or the stripes have no width.
    """
    if not 1 <= len(white) <= 30 or len(black) not in (1, len(white)):
        raise InputError(f"Gray code: {len(white)} frames of bits and {len(black)} beside them; give 1 to 30 of both")
    if not stripe_width > 0:
        raise InputError(f"Gray code: stripes are {stripe_width:g} columns wide; they must be wider than 0")
    contrast = white.astype(np.float32) - black.astype(np.float32)  # (bits, rows, cols)
    strength = np.abs(contrast)
    full = strength.max(axis=0)
    strength /= np.maximum(full, np.finfo(np.float32).tiny)
    weakest = strength.argmin(axis=0)[None]
    uncertain = strength < _CERTAIN
    bits = contrast > 0
    stripe = _count(bits)
    flipped = bits.copy()
    np.put_along_axis(flipped, weakest, ~np.take_along_axis(bits, weakest, axis=0), axis=0)
    beside = _count(flipped)
    on_edge = uncertain.any(axis=0)
    known = (full > _LEAST_CONTRAST * full.max(initial=0)) & (uncertain.sum(axis=0) <= 1)
    known &= ~on_edge | (np.abs(stripe - beside) == 1)
    centre = np.where(on_edge, np.maximum(stripe, beside), stripe + 0.5)
    above, below = _has_neighbour(stripe, 1, known & ~on_edge), _has_neighbour(stripe, -1, known & ~on_edge)
    parted = ~on_edge & (above != below)
    centre = np.where(parted, stripe + above, centre) * stripe_width
    half = np.full(centre.shape, (0.5 + _TOLERANCE) * stripe_width)
    return ColumnWindow(np.where(known, centre, np.nan), half)


def _has_neighbour(stripe: np.ndarray, apart: int, certain: np.ndarray) -> np.ndarray:
    """Whether one of the four pixels beside each shows, for certain, the stripe that is so many further."""
    padded = np.pad(np.where(certain, stripe, -2), 1, constant_values=-2)
    rows, cols = stripe.shape
    found = np.zeros(stripe.shape, dtype=bool)
    for row, col in ((0, 1), (2, 1), (1, 0), (1, 2)):
        beside = padded[row : row + rows, col : col + cols]
        found |= (beside >= 0) & (beside == stripe + apart)
    return found


def _count(bits: np.ndarray) -> np.ndarray:
    """Number of each stripe from the bits of its Gray code, the coarsest first along axis 0."""
    binary = np.logical_xor.accumulate(bits, axis=0)
    return np.tensordot(1 << np.arange(len(bits))[::-1], binary.astype(np.int64), axes=1)
