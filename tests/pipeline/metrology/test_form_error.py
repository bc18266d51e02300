"""Ranges and root mean squares of residuals."""

import numpy as np
import pytest

from greenough.instrument.errors import InputError
from greenough.pipeline.metrology.form_error import FormError, without_worst


def test_a_ramp_of_residuals_has_the_ranges_that_one_counts_off():
    form = FormError.of(np.linspace(-1, 1, 201))
    assert (form.n, form.discarded, form.discarded_share) == (201, 0, 0.0)
    assert form.range_all == pytest.approx(2.0)
    assert form.range_95 == pytest.approx(1.9)
    assert form.rms == pytest.approx(np.sqrt(np.mean((np.arange(201) / 100 - 1) ** 2)))


@pytest.mark.parametrize("n", [2_000, 200_000])
def test_gaussian_noise_ranges_over_3_92_sigma_at_95_percent_whatever_n(n):
    """2 * 1.959964; the difference of two quantiles scatters by sqrt(2 p (1 - 2 p) / n) / density (Mosteller 1946).

    Five standard deviations: a false alarm in 2 million.
    """
    form = FormError.of(np.random.default_rng(3).standard_normal(n))
    p, density = 0.025, np.exp(-(1.959964**2) / 2) / np.sqrt(2 * np.pi)
    assert abs(form.range_95 - 2 * 1.959964) < 5 * np.sqrt(2 * p * (1 - 2 * p) / n) / density


def test_the_range_of_all_grows_with_n_and_so_needs_it():
    few, many = (FormError.of(np.random.default_rng(4).standard_normal(n)) for n in (1_000, 100_000))
    assert few.range_all < 8 < many.range_all < 11


def test_the_worst_are_left_out_on_either_side_and_their_share_is_stated():
    residuals = np.zeros(1000)
    residuals[[10, 20, 30, 40]] = [5, -4, 3, 2]
    kept = without_worst(residuals, 0.003)
    np.testing.assert_array_equal(np.flatnonzero(~kept), [10, 20, 30])
    assert FormError.of(residuals[kept], 3).discarded_share == 0.003
    assert without_worst(residuals, 0.0).all()
    assert without_worst(residuals[:300], 0.003).all()  # 0.9 of a point is none


@pytest.mark.parametrize("share", [-0.001, 0.0031, np.nan])
def test_more_than_3_per_mille_are_never_left_out(share):
    with pytest.raises(InputError, match=r"from 0 to 0\.003"):
        without_worst(np.zeros(1000), share)
