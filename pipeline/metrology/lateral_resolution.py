"""Lateral resolution by the height that is left of ever finer relief, after the lateral period limit of ISO 25178-600.

Relief of known height with a local period that changes over the artefact, such as a chirp or a Siemens star, is
measured; the ratio of measured to true amplitude against the period is the instrument's height transfer, whatever
optics, filter and evaluation made it. The lateral period limit is where it falls to one half.
"""

from dataclasses import dataclass

import numpy as np
from numpy.polynomial import polynomial

from greenough.instrument.errors import InputError

HALF = 0.5
_NEIGHBOURHOOD = 1.4  # factor in period to either side of the limit within which the transfer is smoothed
_DEGREE = 3  # of the polynomial that smooths it: a parabola is not enough for a Gaussian's fall
_LEAST_GROUPS = 6  # there, so that something is left to check the polynomial
_LEAST_POINTS = 8  # of a group


@dataclass(frozen=True, eq=False)
class HeightTransfer:
    """Measured over true amplitude against period, from the longest period to the shortest.

    Parameters
    ----------
    period : (groups,) float64
        Local period of each group's points, mm: their mean, weighted as their heights are in the ratio.
    ratio : (groups,) float64
        Amplitude of the measured relief in phase with the true one, over the true one's: a lateral shift counts as
        loss.
    ratio_sd : (groups,) float64
        Its standard deviation.
    n : (groups,) int
        Points of each group.
    """

    period: np.ndarray
    ratio: np.ndarray
    ratio_sd: np.ndarray
    n: np.ndarray


@dataclass(frozen=True)
class LateralPeriodLimit:
    """Period at which half the height is left.

    Parameters
    ----------
    period, sd : float
        mm.
    groups : int
        Groups of relief that it was read from, all within a factor of 1.4 of it.
    n : int
        Their points.
    """

    period: float
    sd: float
    groups: int
    n: int


def whole_cycles(along: np.ndarray, period: np.ndarray, cycles: int = 1) -> np.ndarray:
    """Numbers (n,) of the groups of ``cycles`` whole cycles that the points of a chirp lie in; -1 in what is left over.

    Parameters
    ----------
    along : (n,)
        Coordinate of each point along the chirp, mm.
    period : (n,)
        The relief's local period there, mm. The phase is the integral of its inverse.
    cycles : int
    """
    order = np.argsort(along, kind="stable")
    frequency = 1 / period[order]
    steps = np.diff(along[order]) * (frequency[1:] + frequency[:-1]) / 2
    phase = np.empty(len(along))
    phase[order] = np.concatenate([[0.0], np.cumsum(steps)])
    group = np.floor(phase / cycles).astype(int)
    return np.where(group < int(phase.max() / cycles), group, -1)


def height_transfer(
    groups: np.ndarray, period: np.ndarray, true: np.ndarray, measured: np.ndarray, strips: np.ndarray | None = None
) -> HeightTransfer:
    """Height transfer of relief: in each group the slope of the regression of measured on true heights.

    Parameters
    ----------
    groups : (n,) int
        Which points belong together: whole cycles of a chirp (:func:`whole_cycles`), or a ring of a star; negative ones
        do not count.
    period : (n,)
        Local period of the relief at each point, mm.
    true : (n,)
        Its height, from the certificate or the drawing, mm.
    measured : (n,)
        Its height as measured, levelled to the same plane, mm; NaN where nothing was measured.
    strips : (n,) int, optional
        Which of several strips across the relief each point lies in. The ratio is then the mean of the strips', each
        with an offset of its own, and their scatter gives its standard deviation: right for any noise that is not
        correlated from strip to strip, as filtered noise is from point to point. Without strips, the residuals give it
        as if errors were independent.

    Raises
    ------
    InputError
        If the arrays do not go together or nothing in them can be evaluated.
    """
    if len({np.shape(a) for a in (groups, period, true, measured)}) > 1 or np.ndim(groups) != 1:
        raise InputError("groups, periods, true and measured heights of relief must be arrays (n,) of one length")
    counts = (groups >= 0) & np.isfinite(measured)
    found = []
    for group in np.unique(groups[counts]):
        of = counts & (groups == group)
        slope = (
            _slope(true[of], measured[of]) if strips is None else _slope_of_strips(true[of], measured[of], strips[of])
        )
        if slope is not None:
            # Heights near the mean say nothing about the slope: periods count as much as their points do in it.
            found.append(
                (float(np.average(period[of], weights=(true[of] - true[of].mean()) ** 2)), *slope, int(of.sum()))
            )
    if not found:
        raise InputError(
            f"no group of relief has {_LEAST_POINTS} measured points at different heights: measure it finer"
        )
    found.sort(reverse=True)
    periods, ratios, sds, n = zip(*found, strict=True)
    return HeightTransfer(np.array(periods), np.array(ratios), np.array(sds), np.array(n))


def lateral_period_limit(transfer: HeightTransfer) -> LateralPeriodLimit:
    """Where the height transfer falls to one half.

    A cubic in the logarithm of the period is fitted to the groups around the first fall below one half, weighted by
    their variances, and solved; its standard deviation grows with the misfit where the cubic fits worse than they
    allow.

    Raises
    ------
    InputError
        If the transfer does not cross one half within the relief's periods, or fewer than 6 groups are near there.
    """
    below = np.flatnonzero(transfer.ratio < HALF)
    if len(below) in (0, len(transfer.ratio)) or below[0] == 0:
        raise InputError(
            f"the height transfer does not fall through one half between periods of {transfer.period.max():.4g} and "
            f"{transfer.period.min():.4g} mm: measure relief with longer and shorter periods"
        )
    k = below[0]
    share = (transfer.ratio[k - 1] - HALF) / (transfer.ratio[k - 1] - transfer.ratio[k])
    start = transfer.period[k - 1] * (transfer.period[k] / transfer.period[k - 1]) ** share
    log_period = np.log(transfer.period / start)
    near = np.abs(log_period) < np.log(_NEIGHBOURHOOD)
    if near.sum() < _LEAST_GROUPS:
        raise InputError(
            f"{near.sum()} groups of relief have periods within a factor of {_NEIGHBOURHOOD:g} of the limit near "
            f"{start:.4g} mm: at least {_LEAST_GROUPS} are needed"
        )
    x, y, sd = log_period[near], transfer.ratio[near], transfer.ratio_sd[near]
    sd = np.maximum(sd, np.median(sd) / 10)  # strips that agree by chance, and exact heights
    weight = 1 / sd if np.all(sd > 0) else np.ones(len(sd))
    design = polynomial.polyvander(x, _DEGREE)
    inverse = np.linalg.pinv(design * weight[:, None])
    fitted = inverse @ (y * weight)
    misfit = np.sum(((y - design @ fitted) * weight) ** 2) / (len(x) - _DEGREE - 1)
    at = _crossing(fitted)
    row = at ** np.arange(_DEGREE + 1)
    variance = row @ inverse @ inverse.T @ row * (max(misfit, 1.0) if np.all(sd > 0) else misfit)
    fall = polynomial.polyval(at, polynomial.polyder(fitted))
    period = float(start * np.exp(at))
    return LateralPeriodLimit(
        period, float(np.sqrt(variance) / abs(fall) * period), int(near.sum()), int(transfer.n[near].sum())
    )


def _crossing(coefficients: np.ndarray) -> float:
    """Where a polynomial, constant first, is one half and rises, nearest to 0."""
    roots = polynomial.polyroots(coefficients - HALF * (np.arange(len(coefficients)) == 0))
    real = roots[np.isreal(roots)].real
    rising = real[polynomial.polyval(real, polynomial.polyder(coefficients)) > 0]
    inside = rising[np.abs(rising) < np.log(_NEIGHBOURHOOD)]
    if len(inside) == 0:
        raise InputError("the height transfer scatters too much to tell where it falls to one half: average more maps")
    return float(inside[np.argmin(np.abs(inside))])


def _slope(true: np.ndarray, measured: np.ndarray) -> tuple[float, float] | None:
    """Slope of the regression of measured on true heights and its standard deviation; None of too few points."""
    from_mean = true - true.mean()
    spread = from_mean @ from_mean
    if len(true) < _LEAST_POINTS or not spread > 0:
        return None
    slope = from_mean @ measured / spread
    residual = measured - measured.mean() - slope * from_mean
    return float(slope), float(np.sqrt(residual @ residual / (len(true) - 2) / spread))


def _slope_of_strips(true: np.ndarray, measured: np.ndarray, strips: np.ndarray) -> tuple[float, float] | None:
    """The same as the mean of strips, weighted by their spreads of true heights, and by their scatter."""
    number = np.unique(strips, return_inverse=True)[1]
    n = np.bincount(number)
    mean_true, mean_measured = (np.bincount(number, weights=z) / n for z in (true, measured))
    from_mean = true - mean_true[number]
    spread = np.bincount(number, weights=from_mean**2)
    product = np.bincount(number, weights=from_mean * (measured - mean_measured[number]))
    usable = (n >= _LEAST_POINTS) & (spread > 0)
    if usable.sum() < 2:
        return None
    weight = spread[usable] / spread[usable].sum()
    slopes = product[usable] / spread[usable]
    mean = weight @ slopes
    strip_count = len(slopes)
    return float(mean), float(np.sqrt(np.sum((weight * (slopes - mean)) ** 2) * strip_count / (strip_count - 1)))
