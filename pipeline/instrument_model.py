"""Both paths of the instrument as one global model: where a pixel with a phase lies, and how well that is known."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from .imaging_path import ImagingPath
from .projector_model import ProjectorModel

_CONVERGED_MM = 1e-10
_ITERATIONS = 60


@dataclass(frozen=True, eq=False)
class InstrumentModel:
    """Camera and projector in one world frame.

    Parameters
    ----------
    camera : ImagingPath
    projector : ProjectorModel
    covariance : (parameters, parameters)
        Of the camera's parameters, then the projector's coefficients.
    """

    camera: ImagingPath
    projector: ProjectorModel
    covariance: np.ndarray

    @property
    def parameters(self) -> int:
        return self.camera.parameters + len(self.projector.coefficients)

    def moved(self, step: np.ndarray) -> "InstrumentModel":
        """The instrument after a step (parameters,)."""
        split = self.camera.parameters
        return replace(self, camera=self.camera.moved(step[:split]), projector=self.projector.moved(step[split:]))

    def points(self, pixels: np.ndarray, height: np.ndarray | Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
        """Points (n, 3) on the rays of pixels (n, 2), at heights (n,) or on a surface that gives z at (n, 2) x, y.

        Newton's method with the slope in the middle of the picture: over a stereomicroscope's field the scale varies
        by a few per cent, so every step gains one to two digits.
        """
        at = height if callable(height) else lambda xy: height
        xyz = np.zeros((len(pixels), 3))
        _, slope, _ = self.camera.linearise(np.zeros((1, 3)))
        inverse = np.linalg.inv(slope[0, :, :2])
        for _ in range(_ITERATIONS):
            xyz[:, 2] = at(xyz[:, :2])
            step = (pixels - self.camera.project(xyz)) @ inverse.T
            xyz[:, :2] += step
            if not np.any(np.abs(step) > _CONVERGED_MM):
                break
        return xyz

    def sensitivity(self, xyz_world: np.ndarray) -> np.ndarray:
        """Change (n, 3, parameters) of points (n, 3) by the parameters, their pixel and their phase staying."""
        _, pixel_by_point, pixel_by_camera = self.camera.linearise(xyz_world)
        _, phase_by_point, phase_by_projector = self.projector.linearise(xyz_world)
        seen = np.concatenate([pixel_by_point, phase_by_point[:, None]], axis=1)  # (n, 3, 3)
        moved = np.zeros((len(xyz_world), 3, self.parameters))
        moved[:, :2, : self.camera.parameters] = pixel_by_camera
        moved[:, 2, self.camera.parameters :] = phase_by_projector
        return -np.linalg.solve(seen, moved)

    def point_covariance(self, xyz_world: np.ndarray) -> np.ndarray:
        """Covariance (3 n, 3 n) in mm² of what the calibration does to points (n, 3), by linear propagation.

        Points near each other share their errors: the covariance of a distance needs the blocks off the diagonal, too.
        """
        sensitivity = self.sensitivity(xyz_world).reshape(-1, self.parameters)
        return sensitivity @ self.covariance @ sensitivity.T
