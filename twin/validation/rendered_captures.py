"""What `greenough.twin.validation.coverage` judges, of one rendered instrument: the whole pipeline on frames."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from greenough.instrument.contract import Placement
from greenough.pipeline.acquisition import calibrate
from greenough.pipeline.bundle_data import measure_spot_phases
from greenough.pipeline.reconstruct import PointMap
from greenough.pipeline.spots import detect_spots

from ..rig import open as open_twin
from .coverage import (
    ACROSS,
    CAP_SHARE,
    ON_CAP,
    PLANE_MM,
    Captures,
    Figures,
    Points,
    figures,
    noise_of_spots,
    plane_height,
    points_of,
)
from .pitch import POSTURE
from .setup import Setup
from .step import STEP_MM


def rendered_coverage(
    rig_name: str, overrides: Sequence[str], run: str, advance: Callable[[float], None]
) -> list[Figures]:
    """Errors and stated uncertainties of the measurands on one drawn instrument, rendered; see `figures`.

    Parameters
    ----------
    rig_name, overrides, run
        As ``greenough.twin.open`` takes them; what is measured is of a run of its own.
    advance : callable
        Called with 1 after each step of the calibration.

    Raises
    ------
    InputError
        As ``calibrate`` does.
    """
    return figures(rendered_captures(rig_name, overrides, run, advance), run)


def rendered_captures(rig_name: str, overrides: Sequence[str], run: str, advance: Callable[[float], None]) -> Captures:
    """Calibrate a rendered twin by the bundle and measure with it in another run."""
    rig, bench = open_twin(rig_name, overrides, run)
    with TemporaryDirectory() as folder, rig:
        calibration = calibrate(rig, Path(folder) / "calibration.h5", run, advance)
    rig, bench = open_twin(rig_name, overrides, f"{run} measured")
    setup = Setup(rig, bench, calibration)
    with rig:
        setup.place(Placement("plane"))
        planes, heights, taken = [], [], []
        for position in (PLANE_MM, -STEP_MM / 2, STEP_MM / 2):
            rig.stage.move_to_mm(position)
            phase_map = setup.capture()
            planes.append(_sampled(setup.points(phase_map), rig.camera.shape[1] / ACROSS))
            heights.append(plane_height(bench.world_from_part))
            taken.append(phase_map.exposures)
        walk = float(calibration.path_drift(taken[2] - taken[1])[2])

        setup.place(Placement("sphere"))
        points = setup.points(setup.capture())
        as_built = bench.specimen.as_built
        centre, diameter = as_built["sphere_centres_mm"][0], float(as_built["sphere_diameters_mm"][0])
        to_axis = points.xyz[..., :2] - (bench.world_from_part[:3] @ [*centre, 1.0])[:2]
        reach = CAP_SHARE * diameter / 2
        on_cap = np.hypot(*np.moveaxis(to_axis, -1, 0)) < reach
        pixels_across = np.sqrt(4 / np.pi * on_cap.sum())
        ball = _sampled(replace(points, xyz=np.where(on_cap[..., None], points.xyz, np.nan)), pixels_across / ON_CAP)

        setup.place(Placement("second-board", posture=POSTURE))
        spots = _measured_spots(setup)
        printed = bench.specimen.as_built["centres_mm"]
    (plane, lower, upper), (height, low, high) = planes, heights
    return Captures((plane, lower, upper), (height, low, high), walk, ball, diameter, spots, printed, rig.board)


def _sampled(points: PointMap, every: float) -> Points:
    """Single pixels ``every`` so many, no noise averaged: they stand for all."""
    assert points.noise_mm is not None
    assert points.uncertainty is not None
    step = max(1, round(every))
    v, u = (
        grid.ravel()
        for grid in np.mgrid[step // 2 : points.xyz.shape[0] : step, step // 2 : points.xyz.shape[1] : step]
    )
    found = Points(
        points.xyz[v, u], np.stack([u, v], axis=-1).astype(float), points.noise_mm[v, u][..., None], points.uncertainty
    )
    return found.seen


def _measured_spots(setup: Setup) -> Points:
    """Where the spots lie by their centres and phases, and what the calibration's own residuals say of their noise."""
    instrument, noise_of = setup.calibration.instrument, setup.calibration.figures
    assert instrument is not None
    phase_map = setup.capture()
    spots = detect_spots(phase_map.background, setup.calibration.board)
    phases = measure_spot_phases(phase_map, spots)
    xyz = points_of(instrument, spots.centres_px, phases.phase_rad)
    sigma_px = np.hypot(spots.sigma_px, noise_of["spot_noise_px"])
    sigma_rad = np.hypot(phases.sigma_rad, noise_of["spot_phase_noise_rad"])
    noise = noise_of_spots(instrument, np.nan_to_num(xyz), sigma_px, sigma_rad)
    return Points(xyz, spots.centres_px, noise, setup.calibration.uncertainty_after(phase_map.exposures))
