"""Amplification and linearity against numbers worked out by hand and another regression."""

import numpy as np
import pytest
from scipy.stats import linregress

from greenough.instrument.errors import InputError
from greenough.pipeline.metrology.amplification import amplification


def test_a_scale_and_an_offset_leave_no_residual():
    certified = np.array([-1.0, 0.1, 0.5, 1.0, 2.0, 2.5])
    found = amplification(certified, 1.002 * certified - 0.01)
    assert found.alpha == pytest.approx(1.002)
    assert found.offset == pytest.approx(-0.01)
    assert found.linearity < 1e-12
    assert (found.n, found.span) == (6, (-1.0, 2.5))


def test_a_bow_is_the_linearity_deviation():
    """x² at -2 ... 2 has the best line y = 2, and departs from it by 2, -1, -2, -1, 2."""
    certified = np.arange(-2.0, 3.0)
    found = amplification(certified, certified + 1e-3 * certified**2)
    assert found.alpha == pytest.approx(1.0)
    assert found.linearity == pytest.approx(2e-3)
    np.testing.assert_allclose(found.residuals, 1e-3 * np.array([2, -1, -2, -1, 2]), atol=1e-15)


def test_slope_and_its_sd_are_those_of_another_regression():
    rng = np.random.default_rng(3)
    certified = rng.uniform(-2, 2, 9)
    measured = 0.98 * certified + 0.01 * rng.standard_normal(9)
    found, peer = amplification(certified, measured), linregress(certified, measured)
    assert found.alpha == pytest.approx(peer.slope)
    assert found.alpha_sd == pytest.approx(peer.stderr)
    assert found.offset == pytest.approx(peer.intercept)


@pytest.mark.parametrize(
    ("certified", "measured", "told"),
    [
        (np.arange(4.0), np.arange(4.0), "at least 5"),
        (np.arange(6.0), np.arange(5.0), "shapes"),
        (np.ones(5), np.arange(5.0), "spread"),
        (np.arange(5.0), np.array([0, 1, np.nan, 3, 4]), "finite"),
    ],
)
def test_lengths_that_make_no_line_are_told(certified, measured, told):
    with pytest.raises(InputError, match=told):
        amplification(certified, measured)
