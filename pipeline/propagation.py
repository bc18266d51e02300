"""From the uncertainty of points to that of what is computed from them: a height, a step, a diameter, a pitch.

Whatever a calibration does to points it does to all of them together, so that the variances of single points say little
about a mean or a distance. Here every independent cause displaces all points at once, by its standard deviation to
either side, and the measurand is evaluated anew: half the difference is what this cause contributes, and the squares
add up. That is the law of propagation of uncertainty (JCGM 100, 5.1) with differences instead of derivatives, and asks
nothing of the measurand but that it is nearly linear over the causes' standard deviations.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.stats import norm

from .calibration_uncertainty import CalibrationUncertainty
from .reconstruct import PointMap

Measurand = Callable[[np.ndarray], float]
"""One number from points (n, 3) in mm."""

NOISE_DRAWS = 200
"""Draws of the noise: a standard deviation of them is known to 5 %."""


@dataclass(frozen=True)
class Estimate:
    """A number with its standard uncertainty, predicted conditional on the models of noise and instrument.

    Parameters
    ----------
    value : float
    noise_sd : float
        By noise: what the next measurement will not repeat. NaN where none was stated.
    calibration_sd : float
        By the calibration and drifts: what further measurements repeat.
    """

    value: float
    noise_sd: float
    calibration_sd: float

    @property
    def sd(self) -> float:
        """Combined standard uncertainty."""
        return float(np.hypot(self.noise_sd, self.calibration_sd))

    def interval(self, level: float = 0.95) -> tuple[float, float]:
        """Where the measurand lies with this probability, for normal errors."""
        half = float(norm.ppf((1 + level) / 2)) * self.sd
        return self.value - half, self.value + half


def estimate(measurand: Measurand, point_map: PointMap, where: np.ndarray, rng: np.random.Generator) -> Estimate:
    """The measurand of the valid points of a map ``where`` (rows, cols) bool, with its uncertainty; see `propagate`.

    Noise counts as independent from pixel to pixel: of a filtered map, whose neighbours share it, too little is stated.

    Raises
    ------
    ValueError
        If the map was made without uncertainties.
    """
    if point_map.noise_mm is None or point_map.uncertainty is None:
        raise ValueError("this point map was made without uncertainties")
    v, u = np.nonzero(where & point_map.valid)
    points, noise = point_map.xyz[v, u], point_map.noise_mm[v, u]
    return propagate(measurand, points, np.stack([u, v], axis=-1), point_map.uncertainty, noise, rng)


def propagate(
    measurand: Measurand,
    points: np.ndarray,
    pixels: np.ndarray,
    uncertainty: CalibrationUncertainty,
    noise: np.ndarray | None,
    rng: np.random.Generator,
) -> Estimate:
    """The measurand of some points, and its uncertainty.

    Parameters
    ----------
    measurand : callable
        Of points (n, 3).
    points : (n, 3)
        In the calibrated frame, mm.
    pixels : (n, 2)
        u, v of the pixels that saw them.
    uncertainty : CalibrationUncertainty
        Of these points: a point map has it.
    noise : (n, 3), (n, 3, m) or None
        What one standard deviation of each point's own noise moves it by, or of ``m`` independent causes of its noise;
        None if noise is left out.
    rng : numpy.random.Generator
        Draws noise, and the pattern of single pixels where the calibration has one.

    Returns
    -------
    Estimate
        In the measurand's unit.
    """
    value = float(measurand(points))
    displacements = uncertainty.displacements(pixels, points[:, 2])  # (n, 3, k)
    contributions = [
        (measurand(points + displacements[..., k]) - measurand(points - displacements[..., k])) / 2
        for k in range(displacements.shape[-1])
    ]
    variance = float(np.sum(np.square(contributions)))
    if uncertainty.pattern_sd_mm.any():
        pattern = np.zeros((*points.shape, 1))
        pattern[:, 2, 0] = np.interp(points[:, 2], uncertainty.heights_mm, uncertainty.pattern_sd_mm)
        variance += _scatter(measurand, points, pattern, rng) ** 2
    noise_sd = float("nan") if noise is None else _scatter(measurand, points, noise.reshape(*points.shape, -1), rng)
    return Estimate(value, noise_sd, float(np.sqrt(variance)))


def _scatter(measurand: Measurand, points: np.ndarray, sd: np.ndarray, rng: np.random.Generator) -> float:
    """Standard deviation of the measurand if every point is displaced by its own multiples of ``sd`` (n, 3, m)."""
    n, _, causes = sd.shape
    draws = [
        measurand(points + np.einsum("nk,nik->ni", rng.standard_normal((n, causes)), sd)) for _ in range(NOISE_DRAWS)
    ]
    return float(np.std(draws, ddof=1))
