"""The calibrated camera as OpenCV and what builds on it read one: YAML, JSON or XML of cv2.FileStorage.

======================================  ================================================================
``camera_name``, ``camera_serial``      text
``image_width``, ``image_height``       px; pixel centres are at integers
``camera_matrix``                       (3, 3) px
``distortion_model``                    ``plumb_bob``
``distortion_coefficients``             (1, 5): k1, k2, p1, p2, and k3 = 0
``camera_from_world``                   (4, 4): takes points of the calibrated frame, mm, to the camera's
``avg_reprojection_error``              px, root mean square over the spots
``skew_left_out_px``                    what cv2.projectPoints is off by at most in the picture, see below
``rays_off_rms_px``, ``rays_off_max_px``  how far the rays that points lie on are from this camera's
======================================  ================================================================

OpenCV's functions take no notice of the skew in ``camera_matrix[0, 1]``. The bundle's rays have a smooth field of
residuals more than this camera: points come from them, and not from the file.
"""

from pathlib import Path

import cv2
import numpy as np

from greenough.instrument.files import atomic_path

from .calibration import Calibration
from .plain_text import plain_text

_SAMPLES = 41  # of the picture, along each side


def write_camera(calibration: Calibration, path: str | Path) -> None:
    """Write the camera of a calibration; the name's ending says how, and the file appears whole or not at all."""
    camera = calibration.camera
    rows, cols = camera.shape
    figures = calibration.figures
    off = rays_off_px(calibration)
    entries = {
        "camera_name": plain_text(calibration.identity.name),
        "camera_serial": plain_text(calibration.identity.camera_serial),
        "calibration_method": calibration.method,
        "image_width": cols,
        "image_height": rows,
        "camera_matrix": camera.camera_matrix,
        "distortion_model": "plumb_bob",
        "distortion_coefficients": np.array([[camera.k1, camera.k2, camera.p1, camera.p2, 0.0]]),
        "length_unit": "mm",
        "camera_from_world": calibration.camera_from_world,
        "avg_reprojection_error": float(
            np.hypot(figures.get("reprojection_rmse_u_px", np.nan), figures.get("reprojection_rmse_v_px", np.nan))
        ),
        "skew_left_out_px": skew_left_out_px(calibration),
        "rays_off_rms_px": float(np.sqrt(np.mean(off**2))) if len(off) else float("nan"),
        "rays_off_max_px": float(off.max(initial=0.0)) if len(off) else float("nan"),
    }
    with atomic_path(path) as temporary:
        storage = cv2.FileStorage(str(temporary), cv2.FILE_STORAGE_WRITE)
        try:
            for name, value in entries.items():
                storage.write(name, value)
        finally:
            storage.release()


def skew_left_out_px(calibration: Calibration) -> float:
    """How far a projection without skew is from one with it, at most in the picture, px."""
    camera = calibration.camera
    v = np.array([0.0, camera.shape[0] - 1.0])
    return float(np.abs(camera.skew * (v - camera.cy) / camera.fy).max())


def rays_off_px(calibration: Calibration) -> np.ndarray:
    """Distances (n,) px from pixels to where the camera images points on their rays, over picture and depth."""
    rows, cols = calibration.camera.shape
    v, u = np.meshgrid(*(np.unique(np.linspace(0, n - 1, _SAMPLES).astype(int)) for n in (rows, cols)), indexing="ij")
    pixels = np.stack([u, v], axis=-1)
    rays, relation = calibration.rays, calibration.phase_height
    rotation, shift = calibration.camera_from_world[:3, :3], calibration.camera_from_world[:3, 3]
    distances = []
    for end in range(2):
        z = np.where(relation.valid[v, u], relation.z_range[v, u, end], np.nan).astype(float)[..., None]
        xyz = np.concatenate([rays.origin[v, u] + z * rays.slope[v, u], z], axis=-1)
        distances.append(np.linalg.norm(calibration.camera.project(xyz @ rotation.T + shift) - pixels, axis=-1))
    found = np.array(distances)
    return found[np.isfinite(found)]
