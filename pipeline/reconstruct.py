"""From absolute phase to points in the calibrated frame (section 3.2 of the paper)."""

from dataclasses import dataclass

import numpy as np

from .calibration import Calibration
from .camera_model import CameraModel
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
    """Height from the phase by eq. 17, then x and y on the undistorted camera ray by eq. 23.

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
    rows, cols = np.nonzero(np.isfinite(z))
    xyz = np.full((*z.shape, 3), np.nan)
    pixels = np.stack([cols, rows], axis=-1)
    xyz[rows, cols] = points_at_height(pixels, z[rows, cols], calibration.camera, calibration.camera_from_world)
    return PointMap(xyz)


def points_at_height(
    pixels: np.ndarray, z: np.ndarray, camera: CameraModel, camera_from_world: np.ndarray
) -> np.ndarray:
    """Points on camera rays at known heights: eq. 23, without its division by u and v.

    With the undistorted direction (x', y') = (x_c / z_c, y_c / z_c) of a pixel, the first two rows of eq. 22 less x'
    and y' times its third are two linear equations in x and y.

    Parameters
    ----------
    pixels : (n, 2)
        (u, v) as seen, that is distorted.
    z : (n,)
        World heights in mm.
    camera : CameraModel
    camera_from_world : (4, 4)

    Returns
    -------
    (n, 3) float64
        In the world frame, mm.
    """
    direction = camera.normalised(pixels)  # (n, 2)
    rotation, translation = camera_from_world[:3, :3], camera_from_world[:3, 3]
    # (n, 2, 3): rows r1 - x' r3 and r2 - y' r3
    rows = rotation[:2] - direction[:, :, None] * rotation[2]
    right = direction * translation[2] - translation[:2] - rows[:, :, 2] * z[:, None]
    (a, b), (c, d) = np.moveaxis(rows[:, :, :2], 0, -1)
    determinant = a * d - b * c
    x = (d * right[:, 0] - b * right[:, 1]) / determinant
    y = (a * right[:, 1] - c * right[:, 0]) / determinant
    return np.stack([x, y, z], axis=-1)
