"""Claims about the chirp."""

import numpy as np
import pytest

from greenough.scenes.chirp import AMPLITUDE_MM, LENGTH_MM, PERIOD_COUNT, PERIODS_MM, chirp, period, relief

X = np.linspace(-LENGTH_MM / 2, LENGTH_MM / 2, 400_001)
AIRY_RADIUS_MM = 0.0213  # 0.61 · 525 nm / 0.015


def test_amplitude_is_constant_and_every_period_whole():
    z, _ = relief(X)
    crests = np.flatnonzero((z[1:-1] > z[:-2]) & (z[1:-1] > z[2:])) + 1
    assert len(crests) == PERIOD_COUNT - 1  # and one at either end
    np.testing.assert_allclose(z[crests], AMPLITUDE_MM, rtol=1e-4)
    np.testing.assert_allclose(z[[0, -1]], AMPLITUDE_MM)
    np.testing.assert_allclose(z.min(), -AMPLITUDE_MM, rtol=1e-6)


def test_the_period_that_is_stated_is_the_distance_of_crests():
    z, _ = relief(X)
    crests = X[1:-1][(z[1:-1] > z[:-2]) & (z[1:-1] > z[2:])]
    between = (crests[1:] + crests[:-1]) / 2
    np.testing.assert_allclose(np.diff(crests), period(between), rtol=2e-3)
    np.testing.assert_allclose(period(np.array([-1, 1]) * LENGTH_MM / 2), PERIODS_MM)


def test_periods_reach_from_ten_times_the_resolution_to_below_it():
    assert PERIODS_MM[0] > 10 * AIRY_RADIUS_MM
    assert PERIODS_MM[1] < 2 * AIRY_RADIUS_MM


def test_the_slope_is_that_of_the_heights():
    d = 1e-7
    inside = X[10:-10:1000]
    np.testing.assert_allclose(
        relief(inside)[1], (relief(inside + d)[0] - relief(inside - d)[0]) / (2 * d), rtol=1e-5, atol=1e-6
    )
    beyond = np.array([-1.0, 1.0]) * (LENGTH_MM / 2 + 0.1)
    np.testing.assert_array_equal(relief(beyond), [[AMPLITUDE_MM, AMPLITUDE_MM], [0, 0]])


@pytest.mark.parametrize("share", [0.25, 0.5])
def test_facets_depart_from_the_relief_by_less_than_a_hundredth_of_a_micrometre(share):
    vertices = chirp().parts[0].vertices
    row = vertices[vertices[:, 1] == vertices[0, 1]]
    x = row[:-1, 0] + share * np.diff(row[:, 0])
    np.testing.assert_allclose(relief(x)[0], row[:-1, 2] + share * np.diff(row[:, 2]), atol=1e-5)
