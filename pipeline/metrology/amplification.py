"""Amplification coefficient and linearity deviation of an axis, after ISO 25178-600."""

from dataclasses import dataclass

import numpy as np

from greenough.instrument.errors import InputError

LEAST_SAMPLES = 5


@dataclass(frozen=True, eq=False)
class Amplification:
    """The line through measured against certified lengths of one axis.

    Parameters
    ----------
    alpha : float
        Amplification coefficient: the line's slope.
    alpha_sd : float
        Its standard deviation by the residuals, whose errors are taken for independent.
    offset : float
        Measured where the certified length is 0, by the line.
    linearity : float
        Linearity deviation: the largest absolute residual.
    residuals : (n,) float64
        Measured less the line.
    span : (float, float)
        Smallest and largest certified length: the figures hold between them.
    """

    alpha: float
    alpha_sd: float
    offset: float
    linearity: float
    residuals: np.ndarray
    span: tuple[float, float]

    @property
    def n(self) -> int:
        """Lengths that were measured."""
        return len(self.residuals)


def amplification(certified: np.ndarray, measured: np.ndarray) -> Amplification:
    """Amplification and linearity from at least 5 certified lengths (n,), such as step heights, as measured (n,).

    The line is that of least squares with a free offset.

    Raises
    ------
    InputError
        If there are fewer than 5 lengths, a number is not finite, or all certified ones are equal.
    """
    certified, measured = np.asarray(certified, dtype=float), np.asarray(measured, dtype=float)
    if certified.ndim != 1 or certified.shape != measured.shape or len(certified) < LEAST_SAMPLES:
        raise InputError(
            f"an amplification needs at least {LEAST_SAMPLES} certified lengths and as many measured ones, but the "
            f"arrays have shapes {certified.shape} and {measured.shape}"
        )
    if not (np.isfinite(certified).all() and np.isfinite(measured).all()):
        raise InputError("an amplification's lengths must be finite: leave out those that were not measured")
    from_mean = certified - certified.mean()
    spread = from_mean @ from_mean
    if not spread > 0:
        raise InputError(f"all certified lengths are {certified[0]:g} mm: spread them over the range of the instrument")
    alpha = from_mean @ measured / spread
    offset = measured.mean() - alpha * certified.mean()
    residuals = measured - offset - alpha * certified
    variance = residuals @ residuals / (len(residuals) - 2)
    return Amplification(
        float(alpha),
        float(np.sqrt(variance / spread)),
        float(offset),
        float(np.abs(residuals).max()),
        residuals,
        (float(certified.min()), float(certified.max())),
    )
