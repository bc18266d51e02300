"""Structure in a map of departures: what the means of its blocks scatter by beyond white noise's share."""

import numpy as np

from .planes import blocks_of, half_measured


def structure(residual: np.ndarray) -> float:
    """Root mean square over blocks of the means beyond what white noise gives them, in the residual's unit.

    A block of n pixels with independent noise of variance σ² has a mean of variance σ²/n, and s², the sample variance
    within the block, estimates σ² from the same picture, whatever the noise model says. So

        mean over blocks of (m² - s²/n)

    estimates the mean square of the structure without bias, as the variance component between groups does in a one-way
    analysis of variance. A course within the blocks raises s², which takes at most 1/n of its square away. Where chance
    makes the difference negative it is taken for 0.

    Parameters
    ----------
    residual : (rows, cols)
        Departures of one exposure, NaN without a point. Not filtered: neighbours must be independent.

    Returns
    -------
    float
        NaN where no block is half measured.
    """
    blocks = blocks_of(residual)
    blocks = blocks[half_measured(blocks)]
    pixels = np.isfinite(blocks).sum(axis=1)
    share = np.nanvar(blocks, axis=1, ddof=1) / pixels
    return _root(np.nanmean(blocks, axis=1) ** 2 - share)


def common_structure(first: np.ndarray, second: np.ndarray) -> float:
    """The structure that two exposures of one scene share, as `structure`, of residuals (rows, cols) each.

    The mean product of their blocks' means: noise, flicker and vibration of one are independent of the other's, so that
    only what lasts is left, as the calibration's error and the scene's own do. NaN where they share no block.
    """
    pair = [blocks_of(residual) for residual in (first, second)]
    both = half_measured(pair[0]) & half_measured(pair[1])
    first_means, second_means = (np.nanmean(blocks[both], axis=1) for blocks in pair)
    return _root(first_means * second_means)


def _root(squares: np.ndarray) -> float:
    return float(np.sqrt(np.maximum(0.0, squares.mean()))) if len(squares) else float("nan")
