"""Claims about the designed nodes: pencils that are cut or bright on one side do not shift what they blur."""

from itertools import combinations_with_replacement

import numpy as np
import pytest
from scipy.special import j1

from greenough.twin.node_design import (
    COUNTS,
    DIMENSIONS,
    NA,
    PIXEL,
    SECOND,
    blur_error,
    design,
    disk,
    expected,
    frequencies,
    moments,
    tent,
)
from greenough.twin.quadrature import nodes, nodes_of_direct_light

PERIOD = 12 * 17.835e-3  # mm, of the densest fringes at the specimen


def test_products_have_the_means_of_random_points():
    rng = np.random.default_rng(1)
    n = 400_000
    radius, angle = np.sqrt(rng.random((2, n))), 2 * np.pi * rng.random((2, n))
    discs = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1).reshape(4, n)
    x = np.concatenate([rng.triangular(-1, 0, 1, (2, n)), discs])
    for degree in (2, 4):
        for product in combinations_with_replacement(range(DIMENSIONS), degree):
            values = np.prod(x[list(product)], axis=0)
            # Of 147 products one passes five standard deviations by chance in 12 000 tries.
            assert abs(values.mean() - expected(product)) < 5 * values.std() / np.sqrt(n), product


def test_samples_of_the_square_fill_tent_and_disk():
    u = np.random.default_rng(2).random((200_000, 2))
    assert np.hypot(*disk(u).T).max() <= 1
    assert np.isclose((disk(u) ** 2).mean(), 1 / 4, atol=2e-3)
    assert np.isclose((tent(u) ** 2).mean(), 1 / 6, atol=2e-3)


@pytest.mark.parametrize("count", COUNTS)
def test_place_in_pixel_and_pupils_are_not_correlated(count):
    half = nodes_of_direct_light(count)[: count // 2].astype(float)
    low_discrepancy = nodes(count, DIMENSIONS)[: count // 2].astype(float)
    assert np.abs(moments(half)[:SECOND]).max() < 5e-5
    assert np.abs(moments(half)[:SECOND]).max() < np.abs(moments(low_discrepancy)[:SECOND]).max() / 100


@pytest.mark.parametrize("count", COUNTS)
@pytest.mark.parametrize("defocus", [0.0, 0.6, -1.3, 1.5])
@pytest.mark.parametrize("direction_deg", [0, 45, 90])
@pytest.mark.parametrize("sign", [1, -1])
def test_fringes_get_the_contrast_of_pixel_and_both_cones(count, defocus, direction_deg, sign):
    u = nodes_of_direct_light(count).astype(float)
    along = np.array([np.cos(np.radians(direction_deg)), np.sin(np.radians(direction_deg))])
    at = tent(u[:, :2]) * PIXEL + defocus * NA * (disk(u[:, 2:4]) + sign * disk(u[:, 4:6]))
    contrast = np.mean(np.cos(2 * np.pi * at @ along / PERIOD))
    x = 2 * np.pi * NA * defocus / PERIOD
    cone = 2 * j1(x) / x if x else 1.0
    pixel = np.prod(np.sinc(along * PIXEL / PERIOD)) ** 2
    assert np.isclose(contrast, pixel * cone**2, atol=2e-3)


@pytest.mark.slow
def test_the_table_is_as_good_as_the_design_makes_it():
    """Where its least squares stop depends on a processor's rounding; how good the nodes are does so by 2 %."""
    shipped, designed = nodes_of_direct_light(16)[:8].astype(float), design(16)[:8]
    at = frequencies()
    for error in (lambda half: blur_error(half, at), lambda half: moments(half)[SECOND:]):
        assert np.isclose(np.std(error(shipped)), np.std(error(designed)), rtol=0.1)
    assert np.abs(moments(designed)[:SECOND]).max() < 5e-5
