"""A grating of dots whose places are known, for the mapping of x and y: other pitch and size than the board's.

White dots in a dark ink on ceramic, whose places scatter less than on a calibration board and are certified dot by
dot. Frame and order of the dots are those of `greenough.scenes.board`; five large ones tell where the grating's middle
is.
"""

import numpy as np

from greenough.instrument.contract import SpotBoard

from .board import BoardErrors, board, print_board
from .parts import Specimen

DRAWING = SpotBoard(
    rows=11,
    cols=15,
    pitch_mm=0.5,
    big_diameter_mm=0.34,
    small_diameter_mm=0.2,
    size_mm=7.6,
    big=((5, 7), (5, 8), (4, 7), (5, 5), (7, 7)),
)

ERRORS = BoardErrors(print_sd_um=0.3, scale_ppm=50.0, bow_um=1.0, wedge_urad=50.0, ink_thickness_um=1.0)


def cross_grating(seed: int) -> Specimen:
    """A grating as it was printed; ``as_built``: ``centres_mm`` (rows * cols, 3), the certified places of its dots."""
    printed = board(print_board(DRAWING, ERRORS, np.random.default_rng(seed)), "printed")
    return Specimen("cross-grating", printed.parts, printed.nominal, printed.as_built)
