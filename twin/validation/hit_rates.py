"""How often intervals may miss before it means something, and whether two ways of drawing instruments agree.

A correct program's 95 % intervals hit with a chance of 95 % each, so that the hits among n draws are binomial. The
acceptance intervals below leave a false alarm of 1 % for all measurands together: Bonferroni's inequality, which holds
however much these depend on each other, gives each an equal share, half of it to either side.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import binom, ks_2samp, norm

FAMILY_FALSE_ALARM = 0.01
LEVEL = 0.95
_HALF_WIDTH = float(norm.ppf((1 + LEVEL) / 2))  # of an interval, in standard deviations


@dataclass(frozen=True)
class HitRate:
    """Hits of one measurand's intervals.

    Parameters
    ----------
    measurand : str
    n : int
        Draws.
    rate : float
        Share of them in which the interval held the truth.
    low, high : float
        Rates between which a correct program stays.
    false_alarm : float
        Chance that a correct program does not, exactly, for this measurand alone.
    sd_ratio : float
        Root mean square of the errors over their stated uncertainties: 1 if these are true.
    """

    measurand: str
    n: int
    rate: float
    low: float
    high: float
    false_alarm: float
    sd_ratio: float

    @property
    def holds(self) -> bool:
        """Whether the rate is one of a correct program."""
        return bool(self.low <= self.rate <= self.high)


@dataclass(frozen=True)
class Agreement:
    """Two samples of one measurand's normalised errors, compared by Kolmogorov and Smirnov.

    Parameters
    ----------
    measurand : str
    n : tuple of 2 ints
    distance : float
        Largest distance of the two empirical distribution functions.
    p_value : float
        Exact chance of a larger one, if both are samples of one distribution.
    limit : float
        The p-value below which they count as different.
    """

    measurand: str
    n: tuple[int, int]
    distance: float
    p_value: float
    limit: float

    @property
    def holds(self) -> bool:
        """Whether nothing speaks against one distribution."""
        return bool(self.p_value >= self.limit)


def hit_rates(normalised: Mapping[str, Sequence[float]]) -> list[HitRate]:
    """Of each measurand, from its errors over their combined standard uncertainties, |e| <= 1.96 being a hit."""
    share = FAMILY_FALSE_ALARM / len(normalised)
    return [_hit_rate(name, np.asarray(errors, dtype=float), share) for name, errors in normalised.items()]


def _hit_rate(measurand: str, normalised: np.ndarray, false_alarm: float) -> HitRate:
    n = len(normalised)
    low, high = acceptable_hits(n, false_alarm)
    hits = int(np.sum(np.abs(normalised) <= _HALF_WIDTH))
    outside = binom.cdf(low - 1, n, LEVEL) + binom.sf(high, n, LEVEL)
    ratio = float(np.sqrt(np.mean(normalised**2)))
    return HitRate(measurand, n, hits / n, low / n, high / n, float(outside), ratio)


def acceptable_hits(n: int, false_alarm: float) -> tuple[int, int]:
    """Fewest and most hits among ``n`` of which neither fewer nor more have a chance above half of ``false_alarm``."""
    return int(binom.ppf(false_alarm / 2, n, LEVEL)), int(binom.isf(false_alarm / 2, n, LEVEL))


def agreements(first: Mapping[str, Sequence[float]], second: Mapping[str, Sequence[float]]) -> list[Agreement]:
    """Of each measurand, whether both samples of normalised errors may be of one distribution."""
    limit = FAMILY_FALSE_ALARM / len(first)
    result = []
    for name in first:
        distance, p_value = np.asarray(ks_2samp(first[name], second[name], method="exact"), dtype=float)
        sizes = len(first[name]), len(second[name])
        result.append(Agreement(name, sizes, float(distance), float(p_value), limit))
    return result
