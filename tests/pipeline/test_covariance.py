"""Inverses and roots of matrices whose scales differ by many powers of ten."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from greenough.pipeline.covariance import covariance_of, covariance_root


def scaled(seed: int, rank: int = 6) -> tuple[np.ndarray, np.ndarray]:
    """A covariance (6, 6) of parameters of sizes from 1e-9 to 1e6, and the sizes."""
    rng = np.random.default_rng(seed)
    factor, sizes = rng.normal(size=(6, rank)) + np.eye(6, rank), 10.0 ** rng.integers(-9, 7, 6)
    return (factor @ factor.T) * np.outer(sizes, sizes), sizes


@given(st.integers(0, 2**32 - 1), st.integers(1, 6))
def test_a_root_times_its_transpose_is_the_covariance_of_whatever_rank(seed, rank):
    covariance, sizes = scaled(seed, rank)
    root = covariance_root(covariance)
    expected = covariance / np.outer(sizes, sizes)
    np.testing.assert_allclose(root @ root.T / np.outer(sizes, sizes), expected, atol=1e-12 * np.abs(expected).max())


@given(st.integers(0, 2**32 - 1))
def test_information_times_its_covariance_is_one(seed):
    information, sizes = scaled(seed, 12)
    product = (information / sizes[:, None]) @ (covariance_of(information) * sizes)
    np.testing.assert_allclose(product, np.eye(6), atol=1e-8)


def test_a_parameter_that_is_certain_has_a_root_of_zero():
    covariance = np.diag([4.0, 0.0])
    np.testing.assert_allclose(covariance_root(covariance) @ covariance_root(covariance).T, covariance, atol=1e-15)
