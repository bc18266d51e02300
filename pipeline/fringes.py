"""The fringe patterns that are projected: the paper's Table 1 and eq. 1."""

import math
from dataclasses import dataclass
from itertools import accumulate, pairwise
from typing import TYPE_CHECKING

from greenough.instrument.errors import InputError

if TYPE_CHECKING:
    import numpy as np


@dataclass(frozen=True)
class FringeSet:
    """Sets of vertical sinusoidal fringes, the coarsest first, each shifted in equal steps over one period.

    Parameters
    ----------
    periods : tuple of float
        Fringe period of each set in projector columns, strictly decreasing. The first one must span every column that
        is lit, because its phase alone carries no fringe order.
    steps : tuple of int
        Number of phase steps N of each set, at least 3.

    Raises
    ------
    InputError
        If the numbers cannot be decoded.
    """

    periods: tuple[float, ...]
    steps: tuple[int, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "periods", tuple(float(period) for period in self.periods))
        if not self.periods or len(self.periods) != len(self.steps):
            raise InputError(
                f"fringe set: {len(self.periods)} periods and {len(self.steps)} steps were given; "
                "give one number of steps for each period, and at least one period"
            )
        if any(not math.isfinite(period) or period <= 2 for period in self.periods):
            raise InputError(f"fringe set: periods {self.periods} must all be finite and longer than 2 columns")
        if any(coarse <= fine for coarse, fine in pairwise(self.periods)):
            raise InputError(f"fringe set: periods {self.periods} must decrease; list the coarsest first")
        if any(int(step) != step or step < 3 for step in self.steps):
            raise InputError(f"fringe set: steps {self.steps} must all be whole numbers of at least 3")
        object.__setattr__(self, "steps", tuple(int(step) for step in self.steps))

    @property
    def frame_count(self) -> int:
        """Number of patterns of all sets together."""
        return sum(self.steps)

    @property
    def ratios(self) -> tuple[float, ...]:
        """Frequency ratio K_i of each set to the coarser one before it (Table 1); 1 for the first."""
        return (1.0, *(coarse / fine for coarse, fine in pairwise(self.periods)))

    @property
    def slices(self) -> tuple[slice, ...]:
        """Where the frames of each set lie in the stack."""
        ends = tuple(accumulate(self.steps))
        return tuple(slice(end - step, end) for end, step in zip(ends, self.steps, strict=True))

    def patterns(self, rows: int, cols: int) -> "np.ndarray":
        """Patterns for a projector of ``rows`` x ``cols`` mirrors.

        Returns
        -------
        (frame_count, rows, cols) uint8
            I_n = 127.5 (1 + cos(2π x / p + 2π n / N)), rounded, for n = 0 ... N - 1 of each set in turn; x is the
            column's index (eq. 1 with A = B = 127.5). Read-only: all rows share one memory.

        Raises
        ------
        InputError
            If the projector has more columns than the coarsest period.
        """
        import numpy as np  # which a command line that asks for help need not load

        if cols > self.periods[0]:
            raise InputError(
                f"fringe set: the coarsest period of {self.periods[0]:g} columns must span all {cols} columns of the "
                "projector; make the first period at least that long"
            )
        column = np.arange(cols)
        lines = [
            127.5 * (1 + np.cos(2 * np.pi * (column / period + n / step)))
            for period, step in zip(self.periods, self.steps, strict=True)
            for n in range(step)
        ]
        # Exact halves must round alike in every period, whatever the cosine's last digit says.
        grey = np.rint(np.round(lines, 9)).astype(np.uint8)  # (frames, cols)
        return np.broadcast_to(grey[:, None, :], (len(grey), rows, cols))


PAPER = FringeSet(periods=(608, 152, 40, 12), steps=(4, 4, 4, 12))
"""The fringe set of the paper's Table 1."""
