"""The camera's rays in the world: where each pixel looks, whatever model says so."""

from dataclasses import dataclass

import numpy as np

from .camera_model import CameraModel

_BLOCK_ROWS = 64


@dataclass(frozen=True, eq=False)
class Rays:
    """x and y of every pixel's ray as straight lines in z: (x, y) = origin + z slope.

    For a pinhole with distortion this is eq. 23 as it stands. Single precision rounds an origin to 0.5 nm.

    Parameters
    ----------
    origin : (rows, cols, 2) float32
        x and y at z = 0, mm; NaN where a pixel has no ray.
    slope : (rows, cols, 2) float32
        dx/dz and dy/dz.
    """

    origin: np.ndarray
    slope: np.ndarray

    def points(self, z: np.ndarray) -> np.ndarray:
        """Points (rows, cols, 3) float64 at heights (rows, cols), NaN where these are."""
        xyz = np.empty((*z.shape, 3))
        xyz[..., :2] = self.origin + z[..., None] * self.slope
        xyz[..., 2] = z
        xyz[np.isnan(xyz).any(axis=-1)] = np.nan
        return xyz

    def points_at(self, pixels: np.ndarray, z: np.ndarray) -> np.ndarray:
        """Points (n, 3) at heights (n,) on the rays of places (n, 2) between pixels, NaN outside the picture.

        Linear between neighbouring pixels: from one to the next the lens's distortion is linear to 1e-6 px.
        """
        rows, cols = self.origin.shape[:2]
        u, v = pixels.T
        with np.errstate(invalid="ignore"):
            outside = ~((u >= 0) & (u <= cols - 1) & (v >= 0) & (v <= rows - 1))
        left = np.clip(np.where(outside, 0, u).astype(int), 0, cols - 2)
        top = np.clip(np.where(outside, 0, v).astype(int), 0, rows - 2)
        right_share, low_share = (u - left)[:, None], (v - top)[:, None]
        ray = 0.0
        for row, col, share in (
            (top, left, (1 - low_share) * (1 - right_share)),
            (top, left + 1, (1 - low_share) * right_share),
            (top + 1, left, low_share * (1 - right_share)),
            (top + 1, left + 1, low_share * right_share),
        ):
            ray = ray + share * np.concatenate([self.origin[row, col], self.slope[row, col]], axis=-1).astype(float)
        points = np.column_stack([ray[:, :2] + z[:, None] * ray[:, 2:], z])
        points[outside] = np.nan
        return points


def rays_of_camera(camera: CameraModel, camera_from_world: np.ndarray) -> Rays:
    """The rays of every pixel of a pinhole with distortion (eq. 23)."""
    rows, cols = camera.shape
    origin, slope = (np.empty((rows, cols, 2), dtype=np.float32) for _ in range(2))
    for top in range(0, rows, _BLOCK_ROWS):
        v, u = np.mgrid[top : min(top + _BLOCK_ROWS, rows), :cols]
        block = slice(top, top + len(v))
        origin[block], slope[block] = _lines(np.stack([u, v], axis=-1), camera, camera_from_world)
    return Rays(origin, slope)


def points_at_height(
    pixels: np.ndarray, z: np.ndarray, camera: CameraModel, camera_from_world: np.ndarray
) -> np.ndarray:
    """Points on camera rays at known heights by eq. 23.

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
    origin, slope = _lines(np.asarray(pixels), camera, camera_from_world)
    return np.column_stack([origin + z[:, None] * slope, z])


def _lines(pixels: np.ndarray, camera: CameraModel, camera_from_world: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """x and y at z = 0 and their change with z, (..., 2) each: eq. 23 without its division by u and v.

    With the undistorted direction (x', y') = (x_c / z_c, y_c / z_c) of a pixel, the first two rows of eq. 22 less x'
    and y' times its third are two linear equations in x and y; z enters their right side linearly.
    """
    direction = camera.normalised(pixels)
    rotation, translation = camera_from_world[:3, :3], camera_from_world[:3, 3]
    # (..., 2, 3): rows r1 - x' r3 and r2 - y' r3
    rows = rotation[:2] - direction[..., None] * rotation[2]
    inverse = np.linalg.inv(rows[..., :2])
    origin = inverse @ (direction * translation[2] - translation[:2])[..., None]
    return origin[..., 0], -(inverse @ rows[..., 2:])[..., 0]
