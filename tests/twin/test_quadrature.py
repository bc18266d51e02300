"""Claims about the nodes of a light path."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from greenough.twin.node_design import COUNTS
from greenough.twin.quadrature import nodes, nodes_of_direct_light


@settings(max_examples=30)
@given(st.integers(1, 10), st.integers(1, 16))
def test_as_many_nodes_as_asked_for_inside_the_unit_cube(power, dimensions):
    u = nodes(2**power, dimensions)
    assert u.shape == (2**power, dimensions)
    assert u.dtype == np.float32
    assert u.min() > 0
    assert u.max() < 1


@settings(max_examples=30)
@given(st.integers(1, 10), st.integers(1, 16))
def test_every_node_has_its_mirror_image(power, dimensions):
    u = nodes(2**power, dimensions)
    half = len(u) // 2
    np.testing.assert_allclose(u[:half] + u[half:], 1, atol=2e-7)


def test_the_nodes_are_the_same_every_time():
    np.testing.assert_array_equal(nodes(64, 6), nodes(64, 6))


@pytest.mark.parametrize("dimension", range(9))
def test_each_dimension_is_stratified(dimension):
    # Each half is a digital net: one of its nodes in each of as many equal intervals.
    u = nodes(64, 9)[:, dimension]
    for half in (u[:32], u[32:]):
        np.testing.assert_array_equal(np.sort(np.floor(half * 32)), np.arange(32))


def test_a_smooth_integrand_gets_far_less_error_than_from_random_points():
    def integrand(u):  # smooth, without symmetry, of mean 1
        return np.prod(u * np.exp(u), axis=-1)

    error = abs(integrand(nodes(1024, 4).astype(float)).mean() - 1)
    random = np.random.default_rng(1).random((200, 1024, 4))
    typical = np.std(integrand(random).mean(axis=-1))
    assert error < typical / 10


@pytest.mark.parametrize("count", [0, 1, 3, 48, -2])
def test_other_counts_are_refused(count):
    with pytest.raises(ValueError, match="power of two"):
        nodes(count, 2)


def test_other_counts_of_direct_light_are_low_discrepancy_nodes():
    np.testing.assert_array_equal(nodes_of_direct_light(256), nodes(256, 6))


@pytest.mark.parametrize("count", COUNTS)
def test_designed_nodes_lie_in_the_unit_cube_with_their_mirror_images(count):
    u = nodes_of_direct_light(count)
    assert u.shape == (count, 6)
    assert u.dtype == np.float32
    assert 0 <= u.min() < u.max() <= 1
    for node in u:
        assert np.abs(u - (1 - node)).max(axis=1).min() < 1e-6
