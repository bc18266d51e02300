"""From absolute phase to points in the calibrated frame (section 3.2 of the paper)."""

from dataclasses import dataclass

import numpy as np

from .calibration import Calibration
from .decode import PhaseMap


@dataclass(frozen=True)
class PointMap:
    """One point per camera pixel.

    Parameters
    ----------
    xyz : (rows, cols, 3) float64
        Points in the calibrated (world) frame, mm; NaN where invalid.
    """

    xyz: np.ndarray

    @property
    def valid(self) -> np.ndarray:
        """(rows, cols) bool."""
        return np.isfinite(self.xyz[..., 2])


def reconstruct(phase_map: PhaseMap, calibration: Calibration) -> PointMap:
    """Height from the phase by eq. 17, then x and y on the pixel's ray, for the paper's method by eq. 23.

    Pixels that are not valid in ``phase_map``, not calibrated, or whose phase lies more than half a plane step outside
    the calibrated range of that pixel are NaN: the relation is not known there.

    Raises
    ------
    InputError
        If the phase map is not of the calibrated camera's size.
    """
    calibration.check_shape(phase_map.absolute.shape)
    relation = calibration.phase_height
    phase = np.where(phase_map.valid, phase_map.absolute, np.nan)
    z = relation.height(phase)
    z[~relation.covers(phase, margin_mm=calibration.procedure.plane_step_mm / 2)] = np.nan
    return PointMap(calibration.rays.points(z))
