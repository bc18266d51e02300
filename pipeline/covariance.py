"""Covariances of parameters whose units differ by many powers of ten: computed where all are scaled to one."""

import numpy as np
from scipy.linalg import cho_factor, cho_solve


def covariance_of(information: np.ndarray) -> np.ndarray:
    """The inverse (n, n) of an information matrix (n, n).

    Raises
    ------
    numpy.linalg.LinAlgError
        If it is not positive definite.
    """
    scale = np.sqrt(np.diag(information))
    return cho_solve(cho_factor(information / np.outer(scale, scale)), np.eye(len(scale))) / np.outer(scale, scale)


def covariance_root(covariance: np.ndarray) -> np.ndarray:
    """A matrix L (n, n) with L Lᵀ = covariance (n, n), also where that is singular."""
    scale = np.sqrt(np.maximum(np.diag(covariance), np.finfo(float).tiny))
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    return scale[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))
