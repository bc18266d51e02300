"""Whether stated intervals hold the truth: four measurands of one drawn instrument that is calibrated anew.

There are two levels. `rendered_captures` is the whole pipeline on frames. `observed_captures` is the bundle on what it
would have been given, and points from the pixels and phases that the same lenses give, with noise drawn.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from greenough.instrument.contract import SpotBoard
from greenough.pipeline.calibration_uncertainty import CalibrationUncertainty
from greenough.pipeline.instrument_model import InstrumentModel
from greenough.pipeline.metrology.sphere import fit_sphere
from greenough.pipeline.propagation import Estimate, propagate

from ..randomness import run_rng
from .pitch import all_pairs
from .planes import plane_terms

MEASURANDS = ("plane height", "step", "sphere diameter", "pitch")
CONFIDENCE = 0.95

PLANE_MM = 0.7
"""Stage position at which a plane's height is measured."""

CAP_SHARE = 0.6
"""Of a ball's radius: so far around its top it is measured, up to slopes of 37 degrees."""

ACROSS = 48  # points across the picture that stand for a plane
ON_CAP = 40  # points across a ball's cap
_NEWTON_STEPS = 6  # the last is far below a nanometre

Figures = dict[str, float | str]


@dataclass(frozen=True, eq=False)
class Points:
    """Measured points, and what makes them uncertain.

    Parameters
    ----------
    xyz : (n, 3)
        mm, in the calibrated frame.
    pixels : (n, 2)
    noise : (n, 3, m)
        What one standard deviation of each of m causes of a point's own noise moves it by.
    uncertainty : CalibrationUncertainty
        What calibration and drifts may do to all of them.
    """

    xyz: np.ndarray
    pixels: np.ndarray
    noise: np.ndarray
    uncertainty: CalibrationUncertainty

    @property
    def seen(self) -> "Points":
        """Those that were measured."""
        there = np.isfinite(self.xyz).all(axis=1) & np.isfinite(self.noise).all(axis=(1, 2))
        return replace(self, xyz=self.xyz[there], pixels=self.pixels[there], noise=self.noise[there])


@dataclass(frozen=True, eq=False)
class Captures:
    """All that is measured with one calibration, and the truth beside it; lengths in mm.

    Parameters
    ----------
    planes : (plane, lower, upper)
        Points of the three captured planes, and their true heights over the world's origin.
    walk_mm : float
        Standard deviation of what the drift of the paths adds to heights between the two planes of the step.
    ball : Points
    diameter : float
    spots : Points
        Of the second board, in its order; NaN where unseen.
    printed : (spots, 3)
    board : SpotBoard
    """

    planes: tuple[Points, Points, Points]
    heights: tuple[float, float, float]
    walk_mm: float
    ball: Points
    diameter: float
    spots: Points
    printed: np.ndarray
    board: SpotBoard


def figures(captures: Captures, run: str) -> list[Figures]:
    """What was measured beside the truth, a line for each measurand.

    Each has ``measurand``; ``error_um``, ``u_noise_um``, ``u_calibration_um`` and ``u_um``, the combined standard
    uncertainty; ``normalised``, the error over it; ``hit``, 1 if the stated 95 % interval holds the truth, else 0.
    """
    return [
        {
            "measurand": name,
            "error_um": 1e3 * (estimate.value - true),
            "u_noise_um": 1e3 * estimate.noise_sd,
            "u_calibration_um": 1e3 * estimate.calibration_sd,
            "u_um": 1e3 * estimate.sd,
            "normalised": (estimate.value - true) / estimate.sd,
            "hit": float(holds(estimate, true)),
        }
        for name, (estimate, true) in zip(MEASURANDS, measured(captures, run_rng(0, run, "coverage")), strict=True)
    ]


def holds(estimate: Estimate, true: float) -> bool:
    """Whether the stated interval contains the truth."""
    low, high = estimate.interval(CONFIDENCE)
    return low <= true <= high


def measured(captures: Captures, rng: np.random.Generator) -> list[tuple[Estimate, float]]:
    """Each measurand as it is estimated, and its true value, mm, in the order of `MEASURANDS`."""
    plane, lower, upper = captures.planes
    height, low, high = captures.heights
    first = len(lower.xyz)
    both = Points(
        np.concatenate([lower.xyz, upper.xyz]),
        np.concatenate([lower.pixels, upper.pixels]),
        np.concatenate([lower.noise, upper.noise]),
        lower.uncertainty,
    )
    step = _estimate(lambda xyz: height_at_origin(xyz[first:]) - height_at_origin(xyz[:first]), both, rng)
    step = replace(step, noise_sd=float(np.hypot(step.noise_sd, captures.walk_mm)))
    pairs = all_pairs(captures.board)
    pairs = pairs[np.isfinite(captures.spots.xyz[pairs]).all(axis=(1, 2))]
    used = np.unique(pairs)
    where = np.searchsorted(used, pairs)  # pairs among the used spots
    spots = replace(
        captures.spots,
        xyz=captures.spots.xyz[used],
        pixels=captures.spots.pixels[used],
        noise=captures.spots.noise[used],
    )
    return [
        (_estimate(height_at_origin, plane, rng), height),
        (step, high - low),
        (_estimate(lambda xyz: fit_sphere(xyz).diameter, captures.ball, rng), captures.diameter),
        (_estimate(lambda xyz: mean_distance(xyz, where), spots, rng), mean_distance(captures.printed[used], where)),
    ]


def height_at_origin(xyz: np.ndarray) -> float:
    """Height over the world's origin of the best plane through points (n, 3)."""
    return float(np.linalg.lstsq(plane_terms(xyz[:, :2]), xyz[:, 2], rcond=None)[0][0])


def mean_distance(points: np.ndarray, pairs: np.ndarray) -> float:
    """Mean distance of pairs (pairs, 2) of points (n, 3)."""
    return float(np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=-1).mean())


def noise_of_spots(
    instrument: InstrumentModel, points: np.ndarray, sigma_px: np.ndarray, sigma_rad: np.ndarray
) -> np.ndarray:
    """What noise of a spot's two coordinates (n,) and of its phase (n,) moves its point by, (n, 3, 3) mm."""
    _, pixel_by_point, _ = instrument.camera.linearise(points)
    _, phase_by_point, _ = instrument.projector.linearise(points)
    by_point = np.concatenate([pixel_by_point, phase_by_point[:, None]], axis=1)
    return np.linalg.inv(by_point) * np.stack([sigma_px, sigma_px, sigma_rad], axis=-1)[:, None]


def _estimate(measurand: Callable[[np.ndarray], float], points: Points, rng: np.random.Generator) -> Estimate:
    return propagate(measurand, points.xyz, points.pixels, points.uncertainty, points.noise, rng)


def plane_height(world_from_plane: np.ndarray) -> float:
    """Height over the world's origin of a plane that is z = 0 in its own frame, (4, 4)."""
    normal, origin = world_from_plane[:3, 2], world_from_plane[:3, 3]
    return float(normal @ origin / normal[2])


def points_of(instrument: InstrumentModel, pixels: np.ndarray, phase: np.ndarray) -> np.ndarray:
    """Points (n, 3) where a model's paths of pixels (n, 2) and phases (n,) meet, NaN where one is; Newton's method."""
    known = np.isfinite(pixels).all(axis=1) & np.isfinite(phase)
    xyz = np.full((len(pixels), 3), np.nan)
    at = instrument.points(pixels[known], np.zeros(int(known.sum())))
    for _ in range(_NEWTON_STEPS):
        pixel, pixel_by_point, _ = instrument.camera.linearise(at)
        there, phase_by_point, _ = instrument.projector.linearise(at)
        slopes = np.concatenate([pixel_by_point, phase_by_point[:, None]], axis=1)
        missed = np.column_stack([pixels[known] - pixel, phase[known] - there])
        at = at + np.linalg.solve(slopes, missed[..., None])[..., 0]
    xyz[known] = at
    return xyz
