"""What stage and board as built must do to heights measured by the paper's method: a prediction without any frame.

The method takes the stage's readings for heights of an ideal plane. Whatever the blank side really does instead, its
own shape included, goes into the relation that is fitted to 30 planes, and comes back with the opposite sign.
"""

import numpy as np
from numpy.polynomial import chebyshev
from scipy.special import ndtri

from ..bench import Bench

DEGREE = 3  # a pixel's relation has four effective parameters
HALF_FIELD_MM = (3.7, 2.9)


def field_grid() -> np.ndarray:
    """Places (n, 2) that stand for the field, mm."""
    x, y = np.meshgrid(*(np.linspace(-half, half, 13) for half in HALF_FIELD_MM))
    return np.column_stack([x.ravel(), y.ravel()])


def systematic_error(bench: Bench, readings: np.ndarray, heights: np.ndarray) -> np.ndarray:
    """Error of z at true ``heights`` (h,) for planes calibrated at stage ``readings`` (planes,): (h, places) mm."""
    grid = field_grid()
    scale = np.abs(readings).max()
    true = np.stack([bench.blank_face_height(reading, grid) for reading in readings])  # (planes, places)
    at_zero = bench.blank_face_height(0.0, grid)
    error, zero = np.empty((len(heights), len(grid))), np.empty(len(grid))
    for k in range(len(grid)):
        relation = chebyshev.chebfit(true[:, k] / scale, readings, DEGREE)
        error[:, k] = chebyshev.chebval(heights / scale, relation) - heights
        zero[k] = chebyshev.chebval(at_zero[k] / scale, relation)
    return error - zero.mean()


def flatness_error(error: np.ndarray) -> float:
    """Root mean square of one height's ``error`` (places,) about its best plane, mm."""
    grid = field_grid()
    design = np.column_stack([np.ones(len(grid)), grid])
    rest = error - design @ np.linalg.lstsq(design, error, rcond=None)[0]
    return float(np.sqrt(np.mean(rest**2)))


def percentile_with_noise(error: np.ndarray, sigma: float, share: float) -> float:
    """The ``share``-quantile of |error + noise| over all of ``error``, for normal noise of ``sigma``, mm."""
    noise = sigma * ndtri((np.arange(199) + 0.5) / 199)
    return float(np.quantile(np.abs(error.ravel()[:, None] + noise), share))
