"""Planes as measured beside the plane as it lies: what every claim about them starts from."""

import numpy as np

from greenough.pipeline.imaging_path import cross_matrices
from greenough.pipeline.reconstruct import PointMap

from .setup import Setup

BLOCK_PX = 16  # noise of 2 um becomes 0.1 um in the mean of a block


def vertical_error(setup: Setup, points: PointMap) -> np.ndarray:
    """z of each point minus the mounted plane's z on the same (x, y), (rows, cols) mm."""
    world_from_part = setup.bench.world_from_part
    normal, origin = world_from_part[:3, 2], world_from_part[:3, 3]
    return (points.xyz - origin) @ normal / normal[2]


def without_plane(setup: Setup, points: PointMap) -> np.ndarray:
    """Vertical departures from the best plane, (rows, cols) mm."""
    error = vertical_error(setup, points)
    valid = np.isfinite(error)
    design = plane_terms(points.xyz[valid][:, :2])
    error[valid] -= design @ np.linalg.lstsq(design, error[valid], rcond=None)[0]
    return error


def plane_terms(xy: np.ndarray) -> np.ndarray:
    """Columns of height and slopes, (n, 3), of planes at places (n, 2)."""
    return np.column_stack([np.ones(len(xy)), xy])


def moved_by_motion(xyz: np.ndarray, slope: np.ndarray) -> np.ndarray:
    """What small motions do to points (n, 3) of a surface of slope s (2,), (n, 3, 6): along x and y, and above it.

    A point p moves by d = t + ω x p and then lies d_z - s · d_xy above the surface; columns are t, then ω.
    """
    by = np.concatenate([np.broadcast_to(np.eye(3), (len(xyz), 3, 3)), -cross_matrices(xyz)], axis=-1)
    by[:, 2] -= slope @ by[:, :2]
    return by


def blocks_of(image: np.ndarray) -> np.ndarray:
    """Square blocks of an image (rows, cols), in single pixels: (blocks, ``BLOCK_PX``²).

    Blocks that the image cuts off are left out.
    """
    rows, cols = (n - n % BLOCK_PX for n in image.shape)
    blocks = image[:rows, :cols].reshape(rows // BLOCK_PX, BLOCK_PX, cols // BLOCK_PX, BLOCK_PX)
    return blocks.swapaxes(1, 2).reshape(-1, BLOCK_PX * BLOCK_PX)


def half_measured(blocks: np.ndarray) -> np.ndarray:
    """Which blocks (blocks, pixels) hold a value in at least half of their pixels, (blocks,) bool."""
    return np.isfinite(blocks).sum(axis=1) >= blocks.shape[1] / 2


def count(values: np.ndarray) -> int:
    """How many values there are beside NaN."""
    return int(np.isfinite(values).sum())


def mean(values: np.ndarray) -> float:
    """Mean of a sample; NaN of none."""
    return float(np.mean(values)) if len(values) else np.nan


def rms(values: np.ndarray) -> float:
    """Root mean square of all values but NaN; NaN of none."""
    return float(np.sqrt(np.nanmean(np.square(values)))) if count(values) else np.nan


def percentile(values: np.ndarray, percent: float) -> float:
    """The ``percent``-quantile of all values but NaN; NaN of none."""
    return float(np.nanpercentile(values, percent)) if count(values) else np.nan
