"""What `greenough.twin.validation.coverage` judges, without rendering: a bundle of observations and points by it."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from greenough.instrument.contract import Placement
from greenough.instrument.rigfile import load_rig_file
from greenough.pipeline.acquisition import calibrate
from greenough.pipeline.bundle import solve_bundle
from greenough.pipeline.calibration_uncertainty import CalibrationUncertainty, uncertainty_of_model
from greenough.pipeline.path_drift import along_ray_per_shift, walk_covariance, walked_mm
from greenough.pipeline.pixel_maps import model_maps

from ..instability import Instability
from ..quadrature import nodes_of_direct_light
from ..randomness import run_rng
from ..rig import open as open_twin
from ..settings import twin_settings
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
from .light_paths import Nodes, renderer_nodes
from .observations import (
    EXPOSING,
    Noise,
    Relief,
    Surface,
    build,
    moved_by,
    observe,
    path_shift,
    phase_of,
    see_spots,
)
from .pitch import POSTURE
from .planes import count, rms
from .setup import Setup
from .step import STEP_MM

NOISE_SEED = 0


def observed_coverage(
    rig_name: str, overrides: Sequence[str], run: str, advance: Callable[[float], None]
) -> list[Figures]:
    """As `rendered_captures.rendered_coverage`, on the level of observations; ``advance`` is called with 1 at the end.

    The noise is that of one rendered instrument with the same settings, which is not among those of a study.
    """
    settings = tuple(setting for setting in overrides if not setting.startswith("twin.seed="))
    result = figures(observed_captures(rig_name, overrides, run, measured_noise(rig_name, settings)), run)
    advance(1)
    return result


@cache
def measured_noise(rig_name: str, overrides: tuple[str, ...]) -> Noise:
    """What rendered frames of instrument `NOISE_SEED` with these settings show, all effects on; once per process.

    Centres and phases of spots: the residuals of its bundle, for the degrees of freedom that they lack. Single pixels:
    what decoding states of a plane's median pixel, which the acceptance holds to what is measured.
    """
    settings, run = [*overrides, f"twin.seed={NOISE_SEED}"], "noise"
    rig, bench = open_twin(rig_name, settings, run)
    with TemporaryDirectory() as folder, rig:
        calibration = calibrate(rig, Path(folder) / "calibration.h5", run)
    rig, bench = open_twin(rig_name, settings, f"{run} measured")
    setup = Setup(rig, bench, calibration)
    with rig:
        setup.place(Placement("plane"))
        phase_map = setup.capture()
    residuals, model = calibration.residuals, calibration.instrument
    assert model is not None
    postures, spots, _ = residuals.spots_px.shape
    fitted = 2 * spots + 6 * (postures - 1) + model.parameters
    return Noise(
        centre_px=_noise_of(residuals.spots_px, fitted * _share(residuals.spots_px, residuals.spot_phases_rad)),
        spot_phase_rad=_noise_of(
            residuals.spot_phases_rad, fitted * _share(residuals.spot_phases_rad, residuals.spots_px)
        ),
        pixel_phase_rad=float(np.median(phase_map.sigma[phase_map.valid])),
    )


def _share(one: np.ndarray, other: np.ndarray) -> float:
    """Of all observations, those of one kind."""
    return count(one) / (count(one) + count(other))


def _noise_of(residuals: np.ndarray, fitted: float) -> float:
    """Standard deviation of noise from residuals, NaN where none was measured, that ``fitted`` parameters made less."""
    n = count(residuals)
    return rms(residuals) * float(np.sqrt(n / (n - fitted)))


def observed_captures(rig_name: str, overrides: Sequence[str], run: str, noise: Noise) -> Captures:
    """Calibrate by observations and measure by them in another run; parameters as those of ``greenough.twin.open``."""
    rig_file = load_rig_file(rig_name, overrides)
    settings = twin_settings(rig_file)
    rng = run_rng(settings.seed, run, "observations")
    instrument = build(rig_file, settings, run)
    calibrating = observe(instrument, noise, rng)
    known, procedure, board = rig_file.uncertainty.contract, rig_file.procedure.contract, rig_file.board.nominal
    drift = walk_covariance(known, procedure, calibrating.exposures_at_postures)
    bundle = solve_bundle(calibrating.data, calibrating.camera, board, calibrating.readings_mm, drift)
    model, heights = bundle.state.instrument, bundle.state.planes[1:, 0]
    low, high = float(heights.min()), float(heights.max())
    drift_share = float(calibrating.exposures_at_postures[-1] / procedure.exposures)
    uncertainty = uncertainty_of_model(model, low, high, known, drift_share)
    along_ray = along_ray_per_shift(*model_maps(model, low, high))

    stability = Instability(settings.stability, settings.seed, f"{run} measured", instrument.instability.exposures)
    measuring = replace(instrument, instability=stability)
    bench, world_from_twin = measuring.workbench, calibrating.world_from_twin
    bench.position = 0.0
    frames = sum(procedure.steps)
    serial = EXPOSING

    def stated() -> CalibrationUncertainty:
        """With the drift of the paths until the present capture is done."""
        return uncertainty.joined(walked_mm(known, procedure, serial + frames) * along_ray[None])

    def seen(pixels: np.ndarray, relief: Relief, nodes: Nodes) -> Points:
        """Points of single pixels of what is mounted."""
        surface = Surface(
            moved_by(measuring, serial, only_densest=True) @ bench.twin_from_part(),
            relief,
            path_shift(measuring, serial),
        )
        phase = phase_of(measuring, surface, pixels, nodes)
        phase = phase + noise.pixel_phase_rad * rng.standard_normal(len(phase))
        xyz = points_of(model, pixels, phase)
        sigma = np.full(len(pixels), noise.pixel_phase_rad)
        own = noise_of_spots(model, np.nan_to_num(xyz), np.zeros(len(pixels)), sigma)[..., 2:]
        within = np.abs(xyz[:, 2]) < STEP_MM  # far beyond are no points
        return Points(np.where(within[:, None], xyz, np.nan), pixels, own, stated()).seen

    def true_pose() -> np.ndarray:
        return world_from_twin @ moved_by(measuring, serial, only_densest=True) @ bench.twin_from_part()

    bench.place(Placement("plane"))
    planes, lie = [], []
    for position in (PLANE_MM, -STEP_MM / 2, STEP_MM / 2):
        bench.position = position
        points = seen(_grid(rig_file.camera.shape, ACROSS), lambda xy: np.zeros(len(xy)), measuring.flat_nodes)
        planes.append(_over_board(points, board.size_mm / 2))
        lie.append(plane_height(true_pose()))
        serial += frames
    walk = walked_mm(known, procedure, frames) * along_ray[2]

    bench.position = 0.0
    bench.place(Placement("sphere"))
    assert bench.mounted is not None
    ball_as_built = bench.mounted.specimen.as_built
    centre, radius = ball_as_built["sphere_centres_mm"][0], float(ball_as_built["sphere_diameters_mm"][0]) / 2
    serial += EXPOSING

    def cap(xy: np.ndarray) -> np.ndarray:
        square = np.sum((xy - centre[:2]) ** 2, axis=1)
        return centre[2] + np.sqrt(np.maximum(radius**2 - square, 0.1 * radius**2))

    top = true_pose() @ [centre[0], centre[1], centre[2], 1.0]
    relief_nodes = renderer_nodes(nodes_of_direct_light(settings.render.nodes), settings)
    reach = CAP_SHARE * radius
    around = top[:2] + reach * _disc(ON_CAP)
    pixels = model.camera.project(
        np.column_stack([around, top[2] + np.sqrt(radius**2 - np.sum((around - top[:2]) ** 2, 1))])
    )
    ball = seen(pixels, cap, relief_nodes)

    bench.place(Placement("second-board", posture=POSTURE))
    serial += frames + EXPOSING
    spots, phases = see_spots(measuring, "second-board", serial, noise, rng)
    xyz = points_of(model, spots.centres_px, phases.phase_rad)
    sigma_px, sigma_rad = np.hypot(spots.sigma_px, bundle.noise[0]), np.hypot(phases.sigma_rad, bundle.noise[1])
    own = noise_of_spots(model, np.nan_to_num(xyz), sigma_px, sigma_rad)
    assert bench.mounted is not None
    return Captures(
        planes=(planes[0], planes[1], planes[2]),
        heights=(lie[0], lie[1], lie[2]),
        walk_mm=float(walk),
        ball=ball,
        diameter=2 * radius,
        spots=Points(xyz, spots.centres_px, own, stated()),
        printed=bench.mounted.specimen.as_built["centres_mm"],
        board=board,
    )


def _grid(shape: tuple[int, int], across: int) -> np.ndarray:
    """Pixels (n, 2) on a square grid."""
    rows, cols = shape
    step = cols / across
    v, u = np.meshgrid(np.arange(step / 2, rows, step), np.arange(step / 2, cols, step), indexing="ij")
    return np.stack([u.ravel(), v.ravel()], axis=-1)


def _disc(across: int) -> np.ndarray:
    """Points (n, 2) of a square grid within the unit disc."""
    ticks = (np.arange(across) + 0.5) / across * 2 - 1
    x, y = np.meshgrid(ticks, ticks)
    inside = np.hypot(x, y) < 1
    return np.stack([x[inside], y[inside]], axis=-1)


def _over_board(points: Points, half_mm: float) -> Points:
    """Where the calibration's planes were seen."""
    inside = np.abs(points.xyz[:, 0]) < half_mm
    return replace(points, xyz=points.xyz[inside], pixels=points.pixels[inside], noise=points.noise[inside])
