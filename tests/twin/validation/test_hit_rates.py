"""Hit rates and agreement: the stated false alarms come out when correct programs are simulated."""

import numpy as np
import pytest
from scipy.stats import binom

from greenough.twin.validation.hit_rates import FAMILY_FALSE_ALARM, acceptable_hits, agreements, hit_rates

NAMES = ("height", "step", "diameter", "pitch")


def drawn(rng, n, sd=1.0, shift=0.0):
    return {name: shift + sd * rng.standard_normal(n) for name in NAMES}


def test_a_correct_program_is_accused_as_rarely_as_stated():
    """2000 studies of 400 draws: accusations are binomial, at most 1 % of them by construction; 5 sd above are 42."""
    rng = np.random.default_rng(1)
    accused = sum(any(not each.holds for each in hit_rates(drawn(rng, 400))) for _ in range(2000))
    assert accused <= binom.isf(1e-6, 2000, FAMILY_FALSE_ALARM)
    stated = sum(each.false_alarm for each in hit_rates(drawn(rng, 400)))
    assert 0 < stated <= FAMILY_FALSE_ALARM
    assert accused >= binom.ppf(1e-6, 2000, 0.5 * stated)


@pytest.mark.parametrize("sd", [0.75, 1.3])
def test_uncertainties_that_are_wrong_by_a_third_are_found(sd):
    """With 400 draws, in 100 of 100 studies: too many hits as well as too few."""
    rng = np.random.default_rng(2)
    assert all(not all(each.holds for each in hit_rates(drawn(rng, 400, sd))) for _ in range(100))


@pytest.mark.parametrize("n", [40, 100, 400])
def test_the_interval_is_the_narrowest_whose_tails_keep_to_their_half(n):
    low, high = acceptable_hits(n, 0.0025)
    assert binom.cdf(low - 1, n, 0.95) <= 0.00125 < binom.cdf(low, n, 0.95)
    assert binom.sf(high, n, 0.95) <= 0.00125
    assert high == n or binom.sf(high - 1, n, 0.95) > 0.00125


def test_rates_ratios_and_limits_are_counted_as_one_counts_them():
    (rate,) = hit_rates({"step": [0.0, 1.0, -1.9, 2.5]})
    assert (rate.n, rate.rate) == (4, 0.75)
    assert rate.sd_ratio == pytest.approx(np.sqrt((1 + 1.9**2 + 2.5**2) / 4))


def test_samples_of_one_distribution_agree_and_of_different_ones_do_not():
    """300 pairs of 40 and 360 draws: false alarms at most 1 %, 5 sd above; a shift by a whole sd is found always."""
    rng = np.random.default_rng(3)
    alarms = sum(any(not a.holds for a in agreements(drawn(rng, 40), drawn(rng, 360))) for _ in range(300))
    assert alarms <= binom.isf(1e-6, 300, FAMILY_FALSE_ALARM)
    for _ in range(20):
        assert not all(a.holds for a in agreements(drawn(rng, 40, shift=1.0), drawn(rng, 360)))
