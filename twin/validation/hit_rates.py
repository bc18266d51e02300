"""How often intervals may miss before it means something, and whether two ways of drawing instruments agree."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import binom, ks_2samp


@dataclass(frozen=True)
class Agreement:
    """Two samples compared by Kolmogorov and Smirnov.

    Parameters
    ----------
    n : tuple of 2 ints
    distance : float
        Largest distance of the two empirical distribution functions.
    p_value : float
        Exact chance of one as large or larger, if both are samples of one distribution.
    """

    n: tuple[int, int]
    distance: float
    p_value: float


def acceptable_hits(n: int, rate: float, false_alarm: float) -> tuple[int, int]:
    """Fewest and most hits among ``n`` draws that each hit with chance ``rate``, but for ``false_alarm``.

    Binomial: neither fewer nor more have a chance above half of it. Where several rates are judged together, give each
    its equal share of the false alarm: by Bonferroni's inequality that holds however much they depend on each other.
    """
    return int(binom.ppf(false_alarm / 2, n, rate)), int(binom.isf(false_alarm / 2, n, rate))


def agreement(first: Sequence[float], second: Sequence[float]) -> Agreement:
    """Whether two samples may be of one distribution."""
    distance, p_value = np.asarray(ks_2samp(first, second, method="exact"), dtype=float)
    return Agreement((len(first), len(second)), float(distance), float(p_value))
