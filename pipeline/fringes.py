"""The fringe patterns that are projected: the paper's Table 1 and eq. 1."""

import math
from dataclasses import dataclass
from itertools import accumulate, pairwise
from typing import TYPE_CHECKING

from greenough.instrument.errors import InputError

if TYPE_CHECKING:
    import numpy as np

    from greenough.instrument.contract import Procedure


@dataclass(frozen=True)
class FringeSet:
    """Sets of sinusoidal fringes, the coarsest first, each shifted in equal steps over one period.

    The n-th of the N frames of a set with the period p is A + B cos(2π x / p + start + sign 2π n / N). Fringes are
    vertical and x counts columns; of horizontal ones, which decode alike, it counts rows.

    Parameters
    ----------
    periods : tuple of float
        Fringe period of each set in projector columns, strictly decreasing. Without ``field`` the first one must span
        every column that is lit, because its phase alone carries no fringe order.
    steps : tuple of int
        Number of phase steps N of each set, at least 3.
    field : float, optional
        Number of lit columns where no period spans them: orders are then told by how the phases of all sets, and a
        Gray code if there is one, fit together (`order_search`).
    start : float
        Phase of every set's first frame on column 0, rad.
    sign : 1 or -1
        Whether the steps move the fringes towards smaller columns, or larger ones.

    Raises
    ------
    InputError
        If the numbers cannot be decoded.
    """

    periods: tuple[float, ...]
    steps: tuple[int, ...]
    field: float | None = None
    start: float = 0.0
    sign: int = 1

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
        if self.field is not None and not (math.isfinite(self.field) and self.field > 1):
            raise InputError(f"fringe set: the field is {self.field:g} columns; it must be finite and more than 1")
        if not math.isfinite(self.start) or self.sign not in (1, -1):
            raise InputError(
                f"fringe set: start {self.start:g} must be a finite angle and the sign, {self.sign}, 1 or -1"
            )

    def _repr_html_(self) -> str:
        from .notebook import fringe_set_html

        return fringe_set_html(self)

    @classmethod
    def of(cls, procedure: "Procedure") -> "FringeSet":
        """The fringes that a rig is calibrated and measured with."""
        return cls(procedure.periods_px, procedure.steps, procedure.field_px, procedure.start_rad, procedure.sign)

    @property
    def frame_count(self) -> int:
        """Number of patterns of all sets together."""
        return sum(self.steps)

    @property
    def ratios(self) -> tuple[float, ...]:
        """Frequency ratio K_i of each set to the coarser one before it (Table 1); 1 for the first."""
        return (1.0, *(coarse / fine for coarse, fine in pairwise(self.periods)))

    @property
    def spans_field(self) -> bool:
        """Whether the coarsest period spans all that is lit."""
        return self.field is None or self.field <= self.periods[0]

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
            I_n = 127.5 (1 + cos(2π x / p + start + sign 2π n / N)), rounded, for n = 0 ... N - 1 of each set in turn;
            x is the column's index (eq. 1 with A = B = 127.5). Read-only: all rows share one memory.

        Raises
        ------
        InputError
            If the projector has more columns than the coarsest period, or than the field if one is given.
        """
        import numpy as np  # which a command line that asks for help need not load

        if cols > (self.field or self.periods[0]):
            raise InputError(
                f"fringe set: the {'field' if self.field else 'coarsest period'} of {self.field or self.periods[0]:g} "
                f"columns must span all {cols} columns of the projector; make the "
                f"{'field' if self.field else 'first period'} at least that long"
            )
        column = np.arange(cols)
        lines = [
            127.5 * (1 + np.cos(2 * np.pi * (column / period + self.sign * n / step) + self.start))
            for period, step in zip(self.periods, self.steps, strict=True)
            for n in range(step)
        ]
        # Exact halves must round alike in every period, whatever the cosine's last digit says.
        grey = np.rint(np.round(lines, 9)).astype(np.uint8)  # (frames, cols)
        return np.broadcast_to(grey[:, None, :], (len(grey), rows, cols))


PAPER = FringeSet(periods=(608, 152, 40, 12), steps=(4, 4, 4, 12))
"""The fringe set of the paper's Table 1."""
