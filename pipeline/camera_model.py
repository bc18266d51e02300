"""Pinhole camera with Brown's distortion (eq. 20-22 of the paper), and the image of a circle's centre in it."""

from dataclasses import dataclass

import numpy as np

_NEWTON_STEPS = 20
_CONVERGED = 1e-13  # in normalised coordinates, that is 2e-9 px at a focal length of 22 683 px


@dataclass(frozen=True)
class CameraModel:
    """Intrinsic parameters of a camera.

    The camera frame has x to the right (u), y down (v), z away from the camera. Pixel centres are at integers.

    Parameters
    ----------
    fx, fy : float
        Focal lengths in px, f_C1 and f_C2 of eq. 20.
    skew : float
        γ_c of eq. 22 in px.
    cx, cy : float
        Principal point (u, v) in px, c_0 and c_1.
    k1, k2 : float
        Radial coefficients of eq. 21.
    p1, p2 : float
        Tangential coefficients in OpenCV's order. The paper calls them k_3 and k_4, which elsewhere are radial terms:
        p1 = k_3 goes with 2xy in x and with r² + 2y² in y; p2 = k_4 with r² + 2x² in x and with 2xy in y.
    shape : tuple of int
        (rows, cols) of the picture.
    """

    fx: float
    fy: float
    skew: float
    cx: float
    cy: float
    k1: float
    k2: float
    p1: float
    p2: float
    shape: tuple[int, int]

    @property
    def camera_matrix(self) -> np.ndarray:
        """M of eq. 22, (3, 3)."""
        return np.array([[self.fx, self.skew, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def skew_angle_deg(self) -> float:
        """Angle between the pixel axes, degrees: arctan(fx / skew) as the paper defines it, in (0, 180)."""
        return float(np.degrees(np.arctan2(self.fx, self.skew)))

    def project(self, xyz_camera: np.ndarray) -> np.ndarray:
        """Pixels (..., 2) of points (..., 3) in the camera frame, mm (eq. 20-22)."""
        xyz = np.asarray(xyz_camera, dtype=float)
        return self.pixels(xyz[..., :2] / xyz[..., 2:])

    def pixels(self, normalised: np.ndarray) -> np.ndarray:
        """Pixels (..., 2) of undistorted normalised coordinates (x/z, y/z), (..., 2)."""
        x, y = np.moveaxis(np.asarray(normalised, dtype=float), -1, 0)
        xd, yd = self._distorted(x, y)
        return np.stack([self.fx * xd + self.skew * yd + self.cx, self.fy * yd + self.cy], axis=-1)

    def normalised(self, uv: np.ndarray) -> np.ndarray:
        """Undistorted normalised coordinates (..., 2) of pixels (..., 2): the inverse of :meth:`pixels`.

        Newton's method on eq. 21; NaN where it does not converge, which happens only where the distortion folds the
        picture over.
        """
        u, v = np.moveaxis(np.asarray(uv, dtype=float), -1, 0)
        yd = (v - self.cy) / self.fy
        xd = (u - self.cx - self.skew * yd) / self.fx
        x, y = xd, yd
        for _ in range(_NEWTON_STEPS):
            fx, fy = self._distorted(x, y)
            a, b, c = self._distortion_jacobian(x, y)
            with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
                det = a * c - b * b
                step_x = (c * (xd - fx) - b * (yd - fy)) / det
                step_y = (a * (yd - fy) - b * (xd - fx)) / det
                x, y = x + step_x, y + step_y
            moved = np.maximum(np.abs(step_x), np.abs(step_y))
            if not np.any(moved > _CONVERGED):
                break
        lost = ~(moved <= _CONVERGED)
        return np.stack([np.where(lost, np.nan, x), np.where(lost, np.nan, y)], axis=-1)

    def pixels_by_normalised(self, normalised: np.ndarray) -> np.ndarray:
        """Derivatives (..., 2, 2) of :meth:`pixels` at undistorted normalised coordinates (..., 2)."""
        a, b, c = self._distortion_jacobian(*np.moveaxis(np.asarray(normalised, dtype=float), -1, 0))
        return self.camera_matrix[:2, :2] @ np.stack([np.stack([a, b], axis=-1), np.stack([b, c], axis=-1)], axis=-2)

    def project_circles(self, centres: np.ndarray, radii: np.ndarray, camera_from_board: np.ndarray) -> np.ndarray:
        """Pixels (..., n, 2) of the centres of the ellipses that circles on a plane appear as.

        A circle of radius r about c with unit normal n is the dual conic r²(I - n nᵀ) - c cᵀ in the camera frame;
        the centre of its image is the pole of the line at infinity, the conic's last column:
        ((c_x c_z + r² n_x n_z) / (c_z² - r²(1 - n_z²)), same in y). It differs from the image of c by about
        f r² sin t cos t / c_z² for a tilt t. Distortion is then applied at that centre: over one spot it is affine to
        far below what a spot's centre can be measured to.

        Parameters
        ----------
        centres : (n, 2) or (n, 3)
            In the board frame, mm; z is zero if left out.
        radii : (n,)
            mm, in planes parallel to the board's z = 0.
        camera_from_board : (..., 4, 4)
            One pose or several.
        """
        rotation, shift = camera_from_board[..., :3, :3], camera_from_board[..., None, :3, 3]
        in_camera = centres @ rotation[..., : centres.shape[-1]].swapaxes(-1, -2) + shift
        cx, cy, cz = np.moveaxis(in_camera, -1, 0)
        nx, ny, nz = np.moveaxis(rotation[..., None, :, 2], -1, 0)
        r2 = np.square(radii)
        denominator = cz**2 - r2 * (1.0 - nz**2)
        ellipse = np.stack([(cx * cz + r2 * nx * nz) / denominator, (cy * cz + r2 * ny * nz) / denominator], axis=-1)
        return self.pixels(ellipse)

    def _distorted(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        r2 = x * x + y * y
        radial = 1.0 + r2 * (self.k1 + self.k2 * r2)
        return (
            x * radial + 2.0 * self.p1 * x * y + self.p2 * (r2 + 2.0 * x * x),
            y * radial + self.p1 * (r2 + 2.0 * y * y) + 2.0 * self.p2 * x * y,
        )

    def _distortion_jacobian(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """d xd/dx, d xd/dy = d yd/dx (Brown's field is the gradient of a potential), d yd/dy."""
        r2 = x * x + y * y
        radial = 1.0 + r2 * (self.k1 + self.k2 * r2)
        slope = 2.0 * self.k1 + 4.0 * self.k2 * r2
        return (
            radial + slope * x * x + 2.0 * self.p1 * y + 6.0 * self.p2 * x,
            slope * x * y + 2.0 * self.p1 * x + 2.0 * self.p2 * y,
            radial + slope * y * y + 6.0 * self.p1 * y + 2.0 * self.p2 * x,
        )
