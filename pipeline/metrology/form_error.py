"""How far points scatter about the ideal surface fitted to them, with what makes such a figure meaningful.

The range of all residuals grows with their number even where the noise stays the same, so it says nothing without N;
that of the central 95 % does not (3.92 standard deviations of Gaussian noise). Both stand side by side, after VDI/VDE
2634-2 and the D95% of ISO 10360-13.
"""

from dataclasses import dataclass

import numpy as np

from greenough.instrument.errors import InputError

LARGEST_DISCARDED_SHARE = 0.003
"""VDI/VDE 2634-2 lets at most this share of the points, the worst ones, be left out."""


@dataclass(frozen=True)
class FormError:
    """Spread of residuals about a fitted surface.

    Parameters
    ----------
    n : int
        Points that count.
    discarded : int
        Points that were left out as the worst.
    range_all : float
        Largest less smallest residual of the ``n`` points.
    range_95 : float
        97.5 % quantile less 2.5 % quantile of their residuals.
    rms : float
        Root mean square of their residuals.
    """

    n: int
    discarded: int
    range_all: float
    range_95: float
    rms: float

    @classmethod
    def of(cls, residuals: np.ndarray, discarded: int = 0) -> "FormError":
        """Of residuals (n,), all of which count; ``discarded`` others do not."""
        low, high = np.quantile(residuals, [0.025, 0.975])
        return cls(
            len(residuals),
            discarded,
            float(np.ptp(residuals)),
            float(high - low),
            float(np.sqrt(np.mean(residuals**2))),
        )

    @property
    def discarded_share(self) -> float:
        """Share of all points that were left out."""
        return self.discarded / (self.n + self.discarded)


def without_worst(residuals: np.ndarray, share: float) -> np.ndarray:
    """Which points (n,) bool remain if at most ``share`` of them, those with the largest residuals (n,), are left out.

    Raises
    ------
    InputError
        If the share is not between 0 and ``LARGEST_DISCARDED_SHARE``.
    """
    if not 0 <= share <= LARGEST_DISCARDED_SHARE:
        raise InputError(
            f"the share of points to discard is {share:g}: it must be from 0 to {LARGEST_DISCARDED_SHARE:g}, as after "
            "VDI/VDE 2634-2; remove stray points by a stated filter instead"
        )
    kept = np.ones(len(residuals), dtype=bool)
    kept[np.argsort(np.abs(residuals), kind="stable")[len(residuals) - int(share * len(residuals)) :]] = False
    return kept
