"""The camera's path from world to pixel: a pinhole with Brown's distortion, and a smooth residual field on top."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from .camera_model import CameraModel
from .legendre_field import DepthField


@dataclass(frozen=True, eq=False)
class ImagingPath:
    """Where the camera images points of the world.

    The field is taken at the undistorted normalised coordinates (x/z, y/z) and the height over the world's z = 0; its
    part linear in depth is what rays do that do not meet in one point. The intrinsic parameters are given: whatever
    they lack is smooth, and the field holds it.

    Parameters
    ----------
    camera : CameraModel
    camera_from_world : (4, 4)
    field : DepthField
    coefficients : (2, terms)
        Of the field, px, along u and along v.
    """

    camera: CameraModel
    camera_from_world: np.ndarray
    field: DepthField
    coefficients: np.ndarray

    @property
    def parameters(self) -> int:
        """How many there are: rotation vector and shift of ``camera_from_world``, field along u, along v."""
        return 6 + self.coefficients.size

    def project(self, xyz_world: np.ndarray) -> np.ndarray:
        """Pixels (n, 2) of points (n, 3)."""
        in_camera = xyz_world @ self.camera_from_world[:3, :3].T + self.camera_from_world[:3, 3]
        normalised = in_camera[:, :2] / in_camera[:, 2:]
        return self.camera.pixels(normalised) + self.field.values(normalised, xyz_world[:, 2]) @ self.coefficients.T

    def linearise(self, xyz_world: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Pixels (n, 2), and their derivatives by the point (n, 2, 3) and by the parameters (n, 2, parameters).

        The rotation vector turns the camera's frame on the left, about the world's origin.
        """
        rotation = self.camera_from_world[:3, :3]
        turned = xyz_world @ rotation.T
        x, y, depth = (turned + self.camera_from_world[:3, 3]).T
        normalised = np.stack([x / depth, y / depth], axis=-1)
        terms, slopes, with_z = self.field.linearise(normalised, xyz_world[:, 2])
        by_normalised = self.camera.pixels_by_normalised(normalised) + np.einsum(
            "kf,nfj->nkj", self.coefficients, slopes
        )
        perspective = np.zeros((len(x), 2, 3))
        perspective[:, 0, 0] = perspective[:, 1, 1] = 1.0 / depth
        perspective[:, :, 2] = -normalised / depth[:, None]
        by_camera_point = by_normalised @ perspective
        by_point = by_camera_point @ rotation
        by_point[:, :, 2] += with_z @ self.coefficients.T
        count = terms.shape[1]
        by_field = np.zeros((len(x), 2, 2 * count))
        by_field[:, 0, :count] = by_field[:, 1, count:] = terms
        by_parameters = np.concatenate([by_camera_point @ -cross_matrices(turned), by_camera_point, by_field], axis=-1)
        return self.camera.pixels(normalised) + terms @ self.coefficients.T, by_point, by_parameters

    def moved(self, step: np.ndarray) -> "ImagingPath":
        """The path after a step (parameters,)."""
        return replace(
            self,
            camera_from_world=moved_pose(self.camera_from_world, step[:6]),
            coefficients=self.coefficients + step[6:].reshape(self.coefficients.shape),
        )


def moved_pose(pose: np.ndarray, step: np.ndarray) -> np.ndarray:
    """A motion (4, 4) after a rotation vector on the left about its own shift, and a shift: ``step`` (6,)."""
    moved = pose.copy()
    moved[:3, :3] = Rotation.from_rotvec(step[:3]).as_matrix() @ pose[:3, :3]
    moved[:3, 3] += step[3:]
    return moved


def cross_matrices(vectors: np.ndarray) -> np.ndarray:
    """(n, 3, 3) matrices of the cross products with vectors (n, 3) on the left."""
    x, y, z = vectors.T
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(-1, 3, 3)
