"""All methods of calibration beside each other, on one drawn instrument, from the same exposures.

Planes that were not calibrated with, flat at several heights and tilted, are measured by every calibration, and truth
says by how much each errs. Heights and places are as calibrated, unless a figure says that the frame was taken out:
the rigid motion that brings all points of all planes nearest to truth. Methods are judged at the same places, those
where all of them measure; how much each measures is a figure of its own.
"""

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from greenough.instrument.contract import Placement, Procedure
from greenough.pipeline.acquisition import METHODS, calibrate_by_methods, calibration_steps
from greenough.pipeline.calibration import Method
from greenough.pipeline.decode import PhaseMap

from ..rig import open as open_twin
from .pitch import sample_sd, second_board_errors
from .planes import blocks_of, half_measured, mean, moved_by_motion, percentile, plane_terms, rms, vertical_error
from .setup import Setup

HEIGHTS_MM = (-1.25, -0.62, 0.02, 0.62, 1.25)
"""Stage positions of flat planes: the outermost make the step, the others lie between the calibration's heights."""

TILTS_DEG = ((14.0, 0.0), (0.0, -14.0), (-9.0, 9.0))
"""Rotations about x and y of tilted planes, at stage position 0. No posture lies so."""

POSTURE_S, TURN_OVER_S, STAGE_MOVE_S = 60.0, 60.0, 5.0
"""What is assumed of hands and stage: to lay and tilt the board anew, to turn it over, to move and to settle."""


@dataclass(frozen=True)
class CalibrationFigures:
    """One method on one instrument. Lengths in µm; NaN where no place is measured by all methods.

    Parameters
    ----------
    calibration : str
        The method.
    origin_um : float
        Mean error of z over all planes.
    z_rms_um, z_p99_um : float
        Error of z over all planes without the rigid frame: root mean square, and 99 % of the absolute values.
    xy_rms_um : float
        Error of x and y without the rigid frame, root mean square of one axis.
    step_um : float
        Error of the distance of the outermost planes, mean over the field.
    step_local_um : float
        The same place by place, root mean square.
    flatness_um : float
        Root mean square error of z about each flat plane's best plane.
    measured_share : float
        Of the places of all planes that are lit and seen, those where this method measures.
    captures, hand_actions, stage_moves : int
        Fringe sequences, times that a person lays or turns the board, and moves of the stage for this method alone.
    rig_min : float
        Minutes at the rig, by the frames' exposure times and what is assumed of hands and stage.
    pitch_mean_um, pitch_sd_um : float
        Errors of the distances of neighbouring spots on the second board against its true ones: mean, and standard
        deviation of single distances. NaN where it was not measured.
    """

    calibration: str
    origin_um: float
    z_rms_um: float
    z_p99_um: float
    xy_rms_um: float
    step_um: float
    step_local_um: float
    flatness_um: float
    measured_share: float
    captures: int
    hand_actions: int
    stage_moves: int
    rig_min: float
    pitch_mean_um: float = float("nan")
    pitch_sd_um: float = float("nan")


@dataclass(frozen=True, eq=False)
class PlaneErrors:
    """A plane by all methods: means over the blocks of the picture, NaN where less than half a block is measured.

    Parameters
    ----------
    places : (blocks, 3)
        True points in the world, mm; NaN where the plane is not lit and seen.
    slope : (2,)
        dz/dx and dz/dy of the plane.
    errors : (methods, blocks, 3)
        Of x, y and z, mm. That of z is vertical, on the plane's own slope; those of x and y are against where the
        pixel's central ray meets the plane.
    """

    places: np.ndarray
    slope: np.ndarray
    errors: np.ndarray


def compare_calibrations(
    rig_name: str, overrides: Sequence[str], run: str, advance: Callable[[float], None]
) -> list[CalibrationFigures]:
    """Calibrate one twin by all methods from the same exposures, and measure planes by each.

    Parameters
    ----------
    rig_name, overrides
        As ``greenough.twin.open`` takes them.
    run : str
        Whose noise and drifts the exposures have.
    advance : callable
        Called with 1 after each posture, plane of the calibration, plane that is measured, and the second board.

    Raises
    ------
    InputError
        As ``calibrate_by_methods`` does.
    """
    rig, _ = open_twin(rig_name, overrides, run=f"{run} calibration")
    exposures_us: list[float] = []

    def noted(steps: float) -> None:
        exposures_us.append(rig.camera.exposure_us)
        advance(steps)

    with rig, tempfile.TemporaryDirectory() as folder:
        outs: dict[Method, Path] = {method: Path(folder) / f"{method}.h5" for method in METHODS}
        calibrations = calibrate_by_methods(rig, outs, f"{run} calibration", noted)
    rig, bench = open_twin(rig_name, overrides, run=f"{run} measurement")
    setups = [Setup(rig, bench, calibrations[method]) for method in METHODS]
    flat, tilted = [], []
    with rig:
        setups[0].place(Placement("plane"))
        for height in HEIGHTS_MM:
            rig.stage.move_to_mm(height)
            flat.append(_seen(setups))
            advance(1)
        for tilt in TILTS_DEG:
            setups[0].place(Placement("plane", pose_mm_deg=(0.0, 0.0, 0.0, *tilt, 0.0)))
            tilted.append(_seen(setups))
            advance(1)
        pitches = second_board_errors(setups)
        advance(1)
    return [
        replace(
            figures_of(method, k, flat, tilted, rig.procedure, exposures_us),
            pitch_mean_um=1e3 * mean(pitches[k]),
            pitch_sd_um=1e3 * sample_sd(pitches[k]),
        )
        for k, method in enumerate(METHODS)
    ]


def comparison_figures(
    rig_name: str, overrides: Sequence[str], run: str, advance: Callable[[float], None]
) -> list[dict[str, float | str]]:
    """`compare_calibrations` as flat lines, for studies."""
    return [asdict(figures) for figures in compare_calibrations(rig_name, overrides, run, advance)]


def _seen(setups: Sequence[Setup]) -> PlaneErrors:
    """The mounted plane, captured once."""
    phase_map, bench = setups[0].capture(), setups[0].bench
    truth = bench.truth()
    true = np.where(truth.lit_and_seen[..., None], truth.xyz_world, np.nan)
    normal = bench.world_from_part[:3, 2]
    return PlaneErrors(
        places=_block_means(true),
        slope=-normal[:2] / normal[2],
        errors=np.stack([_block_means(_errors(setup, phase_map, true)) for setup in setups]),
    )


def _errors(setup: Setup, phase_map: PhaseMap, true: np.ndarray) -> np.ndarray:
    """(rows, cols, 3) mm."""
    points = setup.points(phase_map)
    errors = points.xyz - true
    errors[..., 2] = np.where(np.isfinite(true[..., 2]), vertical_error(setup, points), np.nan)
    return errors


def _block_means(image: np.ndarray) -> np.ndarray:
    """(blocks, n) of an image (rows, cols, n)."""
    columns = []
    for layer in np.moveaxis(image, -1, 0):
        blocks = blocks_of(layer)
        enough = half_measured(blocks)
        column = np.full(len(blocks), np.nan)
        column[enough] = np.nanmean(blocks[enough], axis=1)
        columns.append(column)
    return np.stack(columns, axis=-1)


def figures_of(
    method: Method,
    which: int,
    flat: Sequence[PlaneErrors],
    tilted: Sequence[PlaneErrors],
    procedure: Procedure,
    exposures_us: Sequence[float],
) -> CalibrationFigures:
    """The figures of one method.

    Parameters
    ----------
    method : Method
    which : int
        Its place among the methods of ``PlaneErrors.errors``.
    flat, tilted : sequence of PlaneErrors
        Flat ones from the lowest to the highest.
    procedure : Procedure
    exposures_us : sequence of float
        Exposure time of a frame in each posture, then in each plane of the calibration.
    """
    planes = [*flat, *tilted]
    common = [np.isfinite(plane.errors).all(axis=(0, 2)) for plane in planes]
    errors = [plane.errors[which, here] for plane, here in zip(planes, common, strict=True)]
    places = [plane.places[here] for plane, here in zip(planes, common, strict=True)]
    left = without_frame(errors, places, [plane.slope for plane in planes])
    step = 1e3 * (flat[-1].errors[which, :, 2] - flat[0].errors[which, :, 2])[common[0] & common[len(flat) - 1]]
    bent = [_without_plane(xyz, error[:, 2]) for xyz, error in zip(places[: len(flat)], errors, strict=False)]
    lit = [np.isfinite(plane.places[:, 0]) for plane in planes]
    own = [np.isfinite(plane.errors[which]).all(axis=-1) for plane in planes]
    turned = METHODS[method].needs_planes
    captures = calibration_steps(procedure, [method])
    moves = captures - procedure.postures
    frames_s = 1e-6 * sum(procedure.steps) * sum(exposures_us[:captures])
    hands_s = POSTURE_S * procedure.postures + TURN_OVER_S * turned
    return CalibrationFigures(
        calibration=method,
        origin_um=1e3 * mean(np.concatenate(errors)[:, 2]),
        z_rms_um=1e3 * rms(left[:, 2]),
        z_p99_um=1e3 * percentile(np.abs(left[:, 2]), 99),
        xy_rms_um=1e3 * rms(left[:, :2]),
        step_um=mean(step),
        step_local_um=rms(step),
        flatness_um=1e3 * rms(np.concatenate(bent)),
        measured_share=float(np.sum(np.concatenate(own)) / np.sum(np.concatenate(lit))),
        captures=captures,
        hand_actions=procedure.postures + turned,
        stage_moves=moves,
        rig_min=(frames_s + hands_s + STAGE_MOVE_S * moves) / 60,
    )


def without_frame(
    errors: Sequence[np.ndarray], places: Sequence[np.ndarray], slopes: Sequence[np.ndarray]
) -> np.ndarray:
    """What the best small rigid motion of all points together leaves of their errors, (n, 3).

    Parameters
    ----------
    errors : sequence of (n_i, 3)
        Of each plane: x, y, and z on the plane's own slope.
    places : sequence of (n_i, 3)
    slopes : sequence of (2,)
    """
    moved = [moved_by_motion(xyz, slope) for xyz, slope in zip(places, slopes, strict=True)]
    design, error = np.concatenate(moved).reshape(-1, 6), np.concatenate(errors).ravel()
    return (error - design @ np.linalg.lstsq(design, error, rcond=None)[0]).reshape(-1, 3)


def _without_plane(places: np.ndarray, error: np.ndarray) -> np.ndarray:
    design = plane_terms(places[:, :2])
    return error - design @ np.linalg.lstsq(design, error, rcond=None)[0]
