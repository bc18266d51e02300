import numpy as np
import pytest
from numpy.polynomial import legendre

from greenough.pipeline.legendre_field import DepthField

FIELD = DepthField((0.3, -0.2), (2.0, 1.5), (1, 5), (0, 3), 1.4)


def inside(rng, count=200):
    return rng.uniform([-1.6, -1.6], [2.2, 1.2], (count, 2)), rng.uniform(-1.5, 1.5, count)


def test_terms_are_products_of_legendre_polynomials_and_depth():
    points, z = inside(np.random.default_rng(1))
    s, t = ((points - [0.3, -0.2]) / [2.0, 1.5]).T
    expected = [
        legendre.legval(s, np.eye(6)[i]) * legendre.legval(t, np.eye(6)[j]) * (z / 1.4 if deep else 1.0)
        for (i, j), deep in zip(FIELD.orders, FIELD.with_depth, strict=True)
    ]
    np.testing.assert_allclose(FIELD.values(points, z), np.transpose(expected), atol=1e-12)


def test_every_degree_has_its_terms_once():
    fixed, deep = FIELD.orders[~FIELD.with_depth], FIELD.orders[FIELD.with_depth]
    assert {tuple(pair) for pair in fixed} == {(i, j) for i in range(6) for j in range(6) if 1 <= i + j <= 5}
    assert {tuple(pair) for pair in deep} == {(i, j) for i in range(4) for j in range(4) if i + j <= 3}
    assert (len(fixed), len(deep)) == (20, 10)


def test_derivatives_are_those_of_the_values():
    points, z = inside(np.random.default_rng(2))
    terms, by_point, by_z = FIELD.linearise(points, z)
    np.testing.assert_array_equal(terms, FIELD.values(points, z))
    step = 1e-5
    for axis in range(2):
        shift = step * np.eye(2)[axis]
        expected = (FIELD.values(points + shift, z) - FIELD.values(points - shift, z)) / (2 * step)
        np.testing.assert_allclose(by_point[..., axis], expected, atol=1e-8)
    expected = (FIELD.values(points, z + step) - FIELD.values(points, z - step)) / (2 * step)
    np.testing.assert_allclose(by_z, expected, atol=1e-9)


def test_beyond_its_rectangle_a_field_stays_what_it_is_at_the_rim():
    z = np.array([0.7])
    outside, rim = np.array([[9.0, 0.4]]), np.array([[2.3, 0.4]])
    np.testing.assert_allclose(FIELD.values(outside, z), FIELD.values(rim, z))
    _, by_point, _ = FIELD.linearise(outside, z)
    assert np.abs(by_point[..., 0]).max() == 0.0
    assert np.abs(by_point[..., 1]).max() == pytest.approx(np.abs(FIELD.linearise(rim - [1e-9, 0], z)[1][..., 1]).max())
