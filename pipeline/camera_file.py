"""The calibrated camera as OpenCV and what builds on it read one: YAML, JSON or XML of cv2.FileStorage.

==============================  ========================================================================
``camera_name``                 the rig's, and ``camera_serial``
``image_width``                 px, and ``image_height``; pixel centres are at integers
``camera_matrix``               (3, 3) px, without skew
``distortion_model``            ``plumb_bob``
``distortion_coefficients``     (1, 5): k1, k2, p1, p2, and k3 = 0
``camera_from_world``           (4, 4): takes points of the calibrated frame, mm, to the camera's
``fit_rms_px``, ``fit_max_px``  distance between pixels and where this camera images points on their rays
``avg_reprojection_error``      px: what the calibration itself left over at the spots, root mean square
==============================  ========================================================================

OpenCV's functions take no notice of a skew, and the bundle's rays have a smooth field of residuals besides. Through
long lenses, skew, principal point, tilt and distortion do nearly the same to the picture. So to leave the calibrated
skew out is to be off by tenths of a pixel, while the camera without skew that comes nearest to the calibrated rays, all
else fitted anew over picture and depth, is off by hundredths. That one is written, with the pose that belongs to it.
"""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from greenough.instrument.errors import InputError
from greenough.instrument.files import atomic_path

from .calibration import Calibration
from .plain_text import plain_text

_SAMPLES = (3, 25, 25)  # in depth, down and across the picture
_FEWEST = 100
_UNTIL = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 300, 1e-15)


@dataclass(frozen=True, eq=False)
class OpenCVCamera:
    """A camera of OpenCV's five-parameter model.

    Parameters
    ----------
    matrix : (3, 3) float64
        px, without skew.
    distortion : (5,) float64
        k1, k2, p1, p2, k3.
    camera_from_world : (4, 4) float64
        mm.
    residuals_px : (n,) float64
        Distances between pixels and the images of points on their rays.
    """

    matrix: np.ndarray
    distortion: np.ndarray
    camera_from_world: np.ndarray
    residuals_px: np.ndarray

    @property
    def rms_px(self) -> float:
        """Root mean square of the residuals."""
        return float(np.sqrt(np.mean(self.residuals_px**2)))

    @property
    def max_px(self) -> float:
        """The largest residual."""
        return float(self.residuals_px.max())


def opencv_camera(calibration: Calibration) -> OpenCVCamera:
    """OpenCV's camera that comes nearest to the rays of a calibration, by least squares over picture and depth.

    Raises
    ------
    InputError
        When less than 100 of 1875 points all over the volume are calibrated.
    """
    camera = calibration.camera
    xyz, pixels = _points_on_rays(calibration)
    if len(xyz) < _FEWEST:
        raise InputError("the calibration has too few calibrated pixels to fit a camera to: calibrate again")
    start = camera.camera_matrix * [[1, 0, 1], [1, 1, 1], [1, 1, 1]]
    _, matrix, distortion, rotations, shifts = cv2.calibrateCamera(
        [xyz.astype(np.float32)],
        [pixels.astype(np.float32)],
        camera.shape[::-1],
        start,
        np.array([camera.k1, camera.k2, camera.p1, camera.p2, 0.0]),
        flags=cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_K3,
        criteria=_UNTIL,
    )
    camera_from_world = np.eye(4)
    camera_from_world[:3, :3], camera_from_world[:3, 3] = cv2.Rodrigues(rotations[0])[0], shifts[0].ravel()
    seen = cv2.projectPoints(xyz, rotations[0], shifts[0], matrix, distortion)[0][:, 0]
    residuals = np.linalg.norm(seen - pixels, axis=1)
    return OpenCVCamera(np.asarray(matrix), np.asarray(distortion).ravel(), camera_from_world, residuals)


def write_camera(calibration: Calibration, path: str | Path) -> OpenCVCamera:
    """Write the camera of a calibration; the name's ending says how, and the file appears whole or not at all.

    Returns
    -------
    OpenCVCamera
        What was written.

    Raises
    ------
    InputError
        As `opencv_camera`, and when nothing can be written there.
    """
    camera = opencv_camera(calibration)
    rows, cols = calibration.camera.shape
    figures = calibration.figures
    entries = {
        "camera_name": plain_text(calibration.identity.name),
        "camera_serial": plain_text(calibration.identity.camera_serial),
        "image_width": cols,
        "image_height": rows,
        "camera_matrix": camera.matrix,
        "distortion_model": "plumb_bob",
        "distortion_coefficients": camera.distortion[None],
        "length_unit": "mm",
        "camera_from_world": camera.camera_from_world,
        "fit_rms_px": camera.rms_px,
        "fit_max_px": camera.max_px,
        "avg_reprojection_error": float(np.hypot(figures["reprojection_rmse_u_px"], figures["reprojection_rmse_v_px"])),
    }
    # In memory, since OpenCV does not say when it could not write a file.
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    for name, value in entries.items():
        storage.write(name, value)
    text = storage.releaseAndGetString()
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
    return camera


def _points_on_rays(calibration: Calibration) -> tuple[np.ndarray, np.ndarray]:
    """Points (n, 3) mm all over the calibrated volume, and the pixels (n, 2) whose rays they lie on."""
    depths, *grid = _SAMPLES
    shape = calibration.camera.shape
    places = (np.unique(np.linspace(0, n - 1, count).astype(int)) for n, count in zip(shape, grid, strict=True))
    v, u = (axis.ravel() for axis in np.meshgrid(*places, indexing="ij"))
    relation, rays = calibration.phase_height, calibration.rays
    low, high = np.where(relation.valid[v, u, None], relation.z_range[v, u], np.nan).astype(float).T
    xyz = []
    for share in np.linspace(0, 1, depths):
        z = (low + share * (high - low))[:, None]
        xyz.append(np.concatenate([rays.origin[v, u] + z * rays.slope[v, u], z], axis=1))
    points, pixels = np.concatenate(xyz), np.tile(np.stack([u, v], axis=1).astype(float), (depths, 1))
    known = np.isfinite(points).all(axis=1)
    return points[known], pixels[known]
