"""How many of many intervals must hold the truth, and whether two sets of errors are draws of one distribution.

All limits are for several measurands at once: a program that states what it should fails any of them with no more than
``FALSE_ALARM``, shared out evenly among them (Bonferroni), whatever their errors have in common.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.stats import binom, ks_2samp

FALSE_ALARM = 0.01
"""Of all measurands together."""


@dataclass(frozen=True)
class HitRate:
    """How often intervals held the truth.

    Parameters
    ----------
    measurand : str
    hits, n : int
    low, high : int
        Hits that a correct program leaves, both included.
    """

    measurand: str
    hits: int
    n: int
    low: int
    high: int

    @property
    def rate(self) -> float:
        return self.hits / self.n

    @property
    def holds(self) -> bool:
        """Whether the hits are what the stated probability leaves."""
        return self.low <= self.hits <= self.high

    def __str__(self) -> str:
        verdict = "as stated" if self.holds else "NOT as stated"
        return f"{self.measurand}: {self.hits} of {self.n} hit, {self.low} to {self.high} expected: {verdict}"


def hit_rates(hits: Mapping[str, Sequence[bool]], confidence: float = 0.95) -> list[HitRate]:
    """Each measurand's hits beside what independent intervals of this ``confidence`` leave.

    The limits cut at most half of the measurand's share of ``FALSE_ALARM`` from either side of the binomial
    distribution.
    """
    share = FALSE_ALARM / max(len(hits), 1)
    return [
        HitRate(name, int(np.sum(each)), len(each), *expected_hits(len(each), confidence, share))
        for name, each in hits.items()
    ]


@lru_cache(maxsize=64)
def expected_hits(n: int, confidence: float, false_alarm: float) -> tuple[int, int]:
    """The lowest and the highest number of hits, both included, of ``n`` that each hit with probability ``confidence``.

    Fewer come with a probability of at most half of ``false_alarm``, and so do more. Where n is small there may be no
    number of hits that is too many.
    """
    half = false_alarm / 2
    # ppf(q) is the least k with P(X <= k) >= q: below it lies less than q.
    low = int(binom.ppf(half, n, confidence)) if n else 0
    high = int(binom.isf(half, n, confidence)) if n else 0
    return low, high


@dataclass(frozen=True)
class SameDistribution:
    """Whether two samples of a measurand's errors, in stated standard uncertainties, differ.

    Parameters
    ----------
    measurand : str
    n : (int, int)
    statistic : float
        Largest difference of the two empirical distributions.
    p_value : float
        Probability of at least as much if they are draws of one distribution.
    limit : float
        Below it, they differ.
    """

    measurand: str
    n: tuple[int, int]
    statistic: float
    p_value: float
    limit: float

    @property
    def holds(self) -> bool:
        """Whether they may be draws of one distribution."""
        return self.p_value >= self.limit

    def __str__(self) -> str:
        verdict = "one distribution" if self.holds else "TWO distributions"
        sizes = f"{self.n[0]} and {self.n[1]}"
        return f"{self.measurand}: D = {self.statistic:.2f}, p = {self.p_value:.3g} of {sizes}: {verdict}"


def same_distribution(first: Mapping[str, np.ndarray], second: Mapping[str, np.ndarray]) -> list[SameDistribution]:
    """Kolmogorov's and Smirnov's exact test of two samples for each measurand that both have."""
    names = [name for name in first if name in second]
    results = []
    for name in names:
        test = ks_2samp(first[name], second[name], method="exact")
        n = len(first[name]), len(second[name])
        results.append(
            SameDistribution(name, n, float(test.statistic), float(test.pvalue), FALSE_ALARM / len(names))  # pyright: ignore[reportAttributeAccessIssue]
        )
    return results
