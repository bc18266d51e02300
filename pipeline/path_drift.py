"""The drift of the projected picture against the camera: a random walk along its columns, and what it does to points.

It begins with the run, and the rig file states its standard deviation after as many exposures as a whole calibration
takes. A shift δ on the specimen changes the phase as a rise does, and lifts points along their rays by δ |dΦ/dx| dz/dΦ.
"""

import numpy as np

from greenough.instrument.contract import KnownUncertainty, Procedure

from .phase_height import PhaseHeight
from .rays import Rays

_WINDOW_PX = 8  # to either side of the middle, where the fringes' density is taken


def walked_mm(known: KnownUncertainty, procedure: Procedure, exposures: float) -> float:
    """Standard deviation of the shift on the specimen over so many exposures, from the run's beginning or any other."""
    return known.path_drift_mm * float(np.sqrt(exposures / procedure.exposures))


def walk_covariance(known: KnownUncertainty, procedure: Procedure, exposures: np.ndarray) -> np.ndarray:
    """Covariance (n, n) mm² of the shifts after numbers of exposures (n,): that of the earlier of two."""
    return known.path_drift_mm**2 * np.minimum.outer(exposures, exposures) / procedure.exposures


def along_ray_per_shift(rays: Rays, relation: PhaseHeight) -> np.ndarray:
    """What a unit shift of the fringes across the specimen moves a point by, (3,), in the middle of what is calibrated.

    Over the narrow field it hardly varies.
    """
    calibrated = np.argwhere(relation.valid)
    v, u = calibrated[np.argmin(np.sum((calibrated - calibrated.mean(axis=0)) ** 2, axis=1))]
    window = slice(max(0, v - _WINDOW_PX), v + _WINDOW_PX + 1), slice(max(0, u - _WINDOW_PX), u + _WINDOW_PX + 1)
    here = relation.of_pixels(window)
    phase = here.phase(np.zeros(here.shape))
    xy = rays.origin[window].reshape(-1, 2)
    plane = np.column_stack([np.ones(len(xy)), xy])
    known = np.isfinite(phase).ravel()
    _, *density = np.linalg.lstsq(plane[known], phase.ravel()[known], rcond=None)[0]
    rise = float(np.hypot(*density) * np.nanmean(here.slope(phase)))
    return rise * np.array([*rays.slope[v, u], 1.0])
