"""Hit rates and agreement: the stated false alarms come out when correct programs are simulated."""

import numpy as np
import pytest
from scipy.stats import binom

from greenough.twin.validation.hit_rates import acceptable_hits, agreement

FAMILY, MEASURANDS = 0.01, 4


def test_a_correct_program_is_accused_as_rarely_as_stated():
    """4000 studies of 400 draws and 4 measurands: accusations are binomial, and not rarer than the exact tails say."""
    rng = np.random.default_rng(1)
    low, high = acceptable_hits(400, 0.95, FAMILY / MEASURANDS)
    hits = rng.binomial(400, 0.95, (4000, MEASURANDS))
    accused = int(np.sum(np.any((hits < low) | (hits > high), axis=1)))
    tails = binom.cdf(low - 1, 400, 0.95) + binom.sf(high, 400, 0.95)
    assert MEASURANDS * tails <= FAMILY
    assert binom.ppf(1e-6, 4000, 1 - (1 - tails) ** MEASURANDS) <= accused <= binom.isf(1e-6, 4000, FAMILY)


@pytest.mark.parametrize("sd", [0.75, 1.3])
def test_uncertainties_that_are_wrong_by_a_third_are_found(sd):
    """Of 400 draws: too many hits as well as too few, in 100 of 100 studies of four measurands."""
    rng = np.random.default_rng(2)
    low, high = acceptable_hits(400, 0.95, FAMILY / MEASURANDS)
    for _ in range(100):
        hits = np.sum(np.abs(sd * rng.standard_normal((MEASURANDS, 400))) < 1.959964, axis=1)
        assert np.any((hits < low) | (hits > high))


@pytest.mark.parametrize("n", [40, 100, 400])
def test_the_interval_is_the_narrowest_whose_tails_keep_to_their_half(n):
    low, high = acceptable_hits(n, 0.95, 0.0025)
    assert binom.cdf(low - 1, n, 0.95) <= 0.00125 < binom.cdf(low, n, 0.95)
    assert binom.sf(high, n, 0.95) <= 0.00125
    assert high == n or binom.sf(high - 1, n, 0.95) > 0.00125


def test_samples_of_one_distribution_agree_and_of_different_ones_do_not():
    """400 pairs of 40 and 360 draws: p-values are uniform, so that false alarms of 5 % are binomial."""
    rng = np.random.default_rng(3)
    found = [agreement(rng.standard_normal(40), rng.standard_normal(360)) for _ in range(400)]
    alarms = sum(each.p_value < 0.05 for each in found)
    assert binom.ppf(1e-6, 400, 0.03) <= alarms <= binom.isf(1e-6, 400, 0.05)  # the distance takes steps
    assert found[0].n == (40, 360)
    for _ in range(20):
        assert agreement(1.5 + rng.standard_normal(40), rng.standard_normal(360)).p_value < FAMILY / MEASURANDS
