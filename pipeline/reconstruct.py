"""From absolute phase to points in the calibrated frame (section 3.2 of the paper), and how uncertain they are."""

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from .calibration import Calibration
from .calibration_uncertainty import CalibrationUncertainty
from .decode import PhaseMap

if TYPE_CHECKING:
    from xarray import Dataset


@dataclass(frozen=True, eq=False)
class PointMap:
    """One point per camera pixel.

    Uncertainties are standard ones (one standard deviation), predicted conditional on the models of noise and
    instrument.

    Parameters
    ----------
    xyz : (rows, cols, 3) float64
        Points in the calibrated (world) frame, mm; NaN where invalid. Double, though their last digits are single's:
        fits to a million points in single precision go wrong.
    noise_mm : (rows, cols, 3) float32, optional
        What one standard deviation of its phase's noise moves each point by, along the camera's ray. Noise is
        independent from pixel to pixel unless a filter has made neighbours alike.
    uncertainty : CalibrationUncertainty, optional
        What the calibration and drifts may do, alike for neighbouring points and for every measurement.
    intensity : (rows, cols) float32, optional
        How bright each pixel was above the black level, DN: the background of the phase map.
    """

    xyz: np.ndarray
    noise_mm: np.ndarray | None = None
    uncertainty: CalibrationUncertainty | None = None
    intensity: np.ndarray | None = None

    def to_xarray(self) -> "Dataset":
        """See `datasets.point_map_dataset`."""
        from .datasets import point_map_dataset

        return point_map_dataset(self)

    def _repr_html_(self) -> str:
        from .notebook import point_map_html

        return point_map_html(self)

    @property
    def valid(self) -> np.ndarray:
        """(rows, cols) bool."""
        return np.isfinite(self.xyz[..., 2])

    @property
    def noise_covariance(self) -> np.ndarray:
        """Covariance of each point by noise, (rows, cols, 3, 3) float32 mm²: of rank one."""
        noise = _stated(self.noise_mm)
        return noise[..., :, None] * noise[..., None, :]

    @cached_property
    def calibration_covariance(self) -> np.ndarray:
        """Covariance of each point by the calibration and drifts, (rows, cols, 3, 3) float32 mm²; NaN where invalid."""
        result = np.full((*self.xyz.shape, 3), np.nan, dtype=np.float32)
        v, u = np.nonzero(self.valid)
        result[v, u] = _stated(self.uncertainty).covariance(np.stack([u, v], axis=-1), self.xyz[v, u, 2])
        return result

    @property
    def sigma_noise(self) -> np.ndarray:
        """Standard uncertainty of x, y and z by noise, (rows, cols, 3) mm."""
        return np.abs(_stated(self.noise_mm))

    @property
    def sigma_calibration(self) -> np.ndarray:
        """Standard uncertainty of x, y and z by the calibration and drifts, (rows, cols, 3) mm."""
        return np.sqrt(np.diagonal(self.calibration_covariance, axis1=-2, axis2=-1))

    @property
    def sigma(self) -> np.ndarray:
        """Combined standard uncertainty of x, y and z, (rows, cols, 3) mm."""
        return np.hypot(self.sigma_noise, self.sigma_calibration)


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
    xyz, noise_mm = calibration.point_kernel.points(phase_map.absolute, phase_map.sigma, phase_map.valid)
    return PointMap(xyz, noise_mm, calibration.uncertainty_after(phase_map.exposures), phase_map.background)


def _stated(value):
    if value is None:
        raise ValueError("this point map was made without uncertainties")
    return value
