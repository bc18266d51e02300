"""Whether a map of departures is white noise: its autocorrelation between neighbours, on several scales."""

from dataclasses import dataclass

import numpy as np
from scipy.stats import norm

SCALES_PX = (1, 2, 4, 8, 16, 32)
"""Sides of the blocks whose means are correlated: means find structure of their own size and larger, far below the
noise of a pixel."""

LAGS = ((0, 1), (1, 0), (1, 1), (1, -1))
"""Rows and columns to the neighbours; the other four are the same pairs."""

LEAST_PAIRS = 100


@dataclass(frozen=True, eq=False)
class Whiteness:
    """What the autocorrelation of a map says.

    Parameters
    ----------
    correlations : (scales, lags) float64
        Of the blocks' means.
    scores : (scales, lags) float64
        The same in standard deviations of what white noise gives; NaN where too few pairs of blocks are measured.
    """

    correlations: np.ndarray
    scores: np.ndarray

    @property
    def p_value(self) -> float:
        """Probability, about, that white noise gives a score as large as the largest here, anywhere.

        The scores of all scales and lags are one normal sample of unknown correlation: by Šidák's inequality the
        probability is at most 1 - (1 - p)^m, with p of the largest alone and m scores. A sum of products is not quite
        normal where there are few, on coarse scales: far out in its tails the probability is approximate.
        """
        largest = np.nanmax(np.abs(self.scores))
        scores = int(np.isfinite(self.scores).sum())
        return float(-np.expm1(scores * np.log1p(-2 * norm.sf(largest))))


def whiteness(residual: np.ndarray, sigma: np.ndarray) -> Whiteness:
    """Test a map of departures for correlation between neighbours.

    With x the departures over their standard deviation, the sum of x_i x_j over n pairs of neighbours has the variance
    n if all are independent, and is nearly normal. On coarser scales x is the sum over a block's k measured pixels over
    √k, which has unit variance again. A best plane that was taken out of the map lowers the sum by about its 3 degrees
    of freedom, 3 / √n standard deviations: coarse scales on which fewer than ``LEAST_PAIRS`` are measured are left out.

    Parameters
    ----------
    residual : (rows, cols)
        NaN without a point.
    sigma : (rows, cols)
        Standard deviation that noise predicts of each; only its course over the picture matters.

    Raises
    ------
    ValueError
        If no scale has enough pairs to be tested.
    """
    standard = residual / sigma
    standard = standard / np.sqrt(np.nansum(standard**2) / max(1, np.isfinite(standard).sum()))
    found = [[_correlation(_block_sums(standard, side), *lag) for lag in LAGS] for side in SCALES_PX]
    correlations, pairs = np.moveaxis(np.array(found), -1, 0)
    if np.isnan(correlations).all():
        raise ValueError(f"fewer than {LEAST_PAIRS} pairs of neighbours are measured: whiteness cannot be tested")
    return Whiteness(correlations, correlations * np.sqrt(pairs))


def detectable(noise: float, pixels: int, side_px: int, false_alarms: float) -> float:
    """Structure, in the unit of ``noise``, that `whiteness` finds in half of all cases, root mean square.

    Structure of RMS S that is the same over a block of side s, and its neighbour, correlates their means by (S s / σ)²,
    and the score is that times the root of the number of blocks, pixels / s².

    Parameters
    ----------
    noise : float
        Standard deviation of a pixel.
    pixels : int
        How many are measured.
    side_px : int
        Size of the structure.
    false_alarms : float
        P-value at which structure is called found.
    """
    tests = len(SCALES_PX) * len(LAGS)
    score = norm.isf(-np.expm1(np.log1p(-false_alarms) / tests) / 2)
    return float(noise * np.sqrt(score / (side_px * np.sqrt(pixels))))


def _block_sums(image: np.ndarray, side: int) -> np.ndarray:
    """Sums over blocks of at least half their pixels, over the root of how many there are; NaN with fewer."""
    rows, cols = (n - n % side for n in image.shape)
    blocks = image[:rows, :cols].reshape(rows // side, side, cols // side, side).swapaxes(1, 2)
    count = np.isfinite(blocks).sum(axis=(2, 3))
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(count >= side * side / 2, np.nansum(blocks, axis=(2, 3)) / np.sqrt(count), np.nan)


def _correlation(image: np.ndarray, rows: int, cols: int) -> tuple[float, float]:
    """Mean product with the neighbour that many ``rows`` below and ``cols`` to the right, and of how many pairs."""
    height, width = image.shape
    left, right = max(0, -cols), width - max(0, cols)
    product = image[: height - rows, left:right] * image[rows:, left + cols : right + cols]
    pairs = int(np.isfinite(product).sum())
    return (float(np.nansum(product)) / pairs if pairs >= LEAST_PAIRS else np.nan), pairs
