"""The procedures: how a rig is calibrated and how it measures, against the contract alone (section 4 of the paper)."""

import logging
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path

import cv2
import numpy as np

from greenough.instrument.contract import BLANK, CameraNoise, Frames, Placement, Procedure, Rig
from greenough.instrument.errors import FileError, InputError
from greenough.instrument.files import check_file

from .bundle_data import SpotPhases, check_spot_phases, measure_spot_phases, no_spot_phases
from .bundle_method import calibrate_by_bundle
from .calibration import Calibration, Method
from .calibration_data import CalibrationData
from .camera_calibration import MIN_POSTURES, calibrate_camera
from .decode import PhaseMap
from .deconvolution import deconvolve_phasors
from .exposure import auto_exposure, capture_bracketed
from .grey_variance import GreyVariance
from .paper_method import calibrate_by_paper
from .phase_height import MIN_PLANES
from .phasor_filter import filter_phasors
from .point_spread import estimate_point_spread
from .reconstruct import PointMap, reconstruct
from .sequence import decode_sequence, sequence_patterns
from .spot_grid import MIN_SPOTS
from .spots import BoardNotFound, Spots, detect_spots
from .stage_free_method import calibrate_by_postures
from .triangulation_method import calibrate_by_triangulation
from .unfinished import Step, Unfinished

_log = logging.getLogger(__name__)

ZERO = "zero"
"""Name of the plane in which the board's two sides meet: its blank side at stage position 0."""

FLAT = "flat"
"""Name of the posture in which the board lies flat: it carries the world frame."""

RIM_PX = 10
"""A calibration plane does not count this near to the rim of the board or of the light, where blur mixes in what is not
the board: four to five Airy radii of 2.2 px, as far as the pattern's skirt and defocus are felt."""


@dataclass(frozen=True)
class CalibrationMethod:
    """How a calibration is computed, and what must have been captured for it.

    Parameters
    ----------
    calibrate : callable
        CalibrationData to Calibration.
    needs_planes : bool
        Whether the board is turned over and the stage lifts its blank side through the planes. Without, the data that
        ``calibrate`` is given hold none.
    needs_spot_phases : bool
        Whether the fringes on the spots are used.
    """

    calibrate: Callable[[CalibrationData], Calibration]
    needs_planes: bool
    needs_spot_phases: bool


METHODS: Mapping[Method, CalibrationMethod] = {
    "paper": CalibrationMethod(calibrate_by_paper, needs_planes=True, needs_spot_phases=False),
    "bundle": CalibrationMethod(calibrate_by_bundle, needs_planes=True, needs_spot_phases=True),
    "stage-free": CalibrationMethod(calibrate_by_postures, needs_planes=False, needs_spot_phases=True),
    "triangulation": CalibrationMethod(calibrate_by_triangulation, needs_planes=False, needs_spot_phases=True),
}


def calibration_steps(procedure: Procedure, methods: Iterable[Method]) -> int:
    """How often `calibrate_by_methods` calls ``advance``: once for each posture and each plane that these need."""
    planes = procedure.planes + 1 if any(METHODS[method].needs_planes for method in methods) else 0
    return procedure.postures + planes


def calibrate(
    rig: Rig,
    out: str | Path,
    run: str = "default",
    advance: Callable[[float], None] = lambda steps: None,
    method: Method = "bundle",
) -> Calibration:
    """Calibrate a rig by one method and write the calibration; see `calibrate_by_methods`."""
    return calibrate_by_methods(rig, {method: out}, run, advance)[method]


def calibrate_by_methods(
    rig: Rig,
    outs: Mapping[Method, str | Path],
    run: str = "default",
    advance: Callable[[float], None] = lambda steps: None,
) -> dict[Method, Calibration]:
    """Calibrate a rig by one method or several, all from the same exposures, and write the calibrations.

    The board is shown tilted in all postures but one, then flat, each with fringes, from whose background the spots
    are found. Methods that need no more are computed. If others were asked for, the board is then turned over, and the
    stage lifts its blank side through the planes; if not, nothing is turned and the stage stays. The exposure is set
    once for each side, and again after a posture in which the board was not found.

    Every finished posture and plane is kept in ``OUT.partial``, beside the first of ``outs``; when the run is
    interrupted, the same call with a rig opened at ``exposures_done=Unfinished.beside(out).exposures`` goes on from
    there, to the same calibrations. The planes are read from there by strips of the picture, so that memory does not
    grow with their number. The folder is removed when the calibrations have been written.

    Parameters
    ----------
    rig : Rig
        Open, that is inside its context.
    outs : mapping
        The file of each method's calibration, of any of ``METHODS``.
    run : str
        The run that the rig was opened for.
    advance : callable
        Called with 1 after each of the ``calibration_steps``.

    Raises
    ------
    InputError
        If ``OUT.partial`` belongs to another rig, settings or run, the planes are too few or lie outside the stage's
        limits, the flat board or too many tilted ones were not found, the postures are all parallel, or a method lacks
        data.
    FileError
        If a file cannot be written or read; what was captured is kept.
    """
    heights = plane_heights(rig) if any(METHODS[method].needs_planes for method in outs) else np.empty(0)
    for method in outs:
        if METHODS[method].needs_spot_phases and not rig.procedure.fringes_on_postures:
            raise InputError(
                f"the method {method} needs fringes on the board's postures, and rig {rig.identity.name} shows them in "
                "white light: project the fringes there as well, or calibrate with --method paper"
            )
    for out in outs.values():
        check_file(out)
    unfinished = Unfinished.beside(next(iter(outs.values())))
    unfinished.begin(rig, run)
    try:
        return _calibrate(rig, outs, run, advance, unfinished, heights)
    except FileError as error:
        if not unfinished.holds_steps:
            raise
        raise FileError(
            f"{error}; what was captured is kept in {unfinished.folder}, and the same command goes on from there"
        ) from None


def _calibrate(
    rig: Rig,
    outs: Mapping[Method, str | Path],
    run: str,
    advance: Callable[[float], None],
    unfinished: Unfinished,
    heights: np.ndarray,
) -> dict[Method, Calibration]:
    """What `calibrate_by_methods` does once nothing is left to refuse."""
    with_planes: list[Method] = [method for method in outs if METHODS[method].needs_planes]
    without_planes: list[Method] = [method for method in outs if not METHODS[method].needs_planes]
    acquire = _Acquirer(rig, unfinished, advance)
    data = _acquire_postures(rig, unfinished, acquire, run, any(METHODS[method].needs_spot_phases for method in outs))
    made: dict[Method, Calibration] = {}
    with unfinished.repeated_on_refusal(f"posture-{name}" for name, _ in _postures(rig)):
        for method in without_planes:
            made[method] = METHODS[method].calibrate(data)
    if with_planes:
        data = _acquire_planes(data, acquire, heights)
        planes = [f"plane-{k:02d}" for k in range(len(heights))]
        with (
            unfinished.repeated_on_refusal([f"plane-{ZERO}", *planes]),
            unfinished.stacked(planes, "phase_rad") as phases,
        ):
            for method in with_planes:
                made[method] = METHODS[method].calibrate(replace(data, phases=phases))
    for method, out in outs.items():
        made[method].save(out)
    unfinished.remove()
    return {method: made[method] for method in outs}


def _acquire_postures(
    rig: Rig, unfinished: Unfinished, acquire: "_Acquirer", run: str, needs_spot_phases: bool
) -> CalibrationData:
    """All postures, done or kept from before, and no planes."""
    postures, exposures = {}, {}
    for name, placement in _postures(rig):
        postures[name] = acquire.posture(name, placement)
        exposures[name] = acquire.exposures
    missing = tuple(name for name, found in postures.items() if found is None)
    found = {name: seen for name, seen in postures.items() if seen is not None}
    with unfinished.repeated_on_refusal(f"posture-{name}" for name in missing):
        _check_found(postures.keys(), missing)
    names = list(found)
    with unfinished.repeated_on_refusal(f"posture-{name}" for name in postures):
        spots = tuple(spots for spots, _ in found.values())
        camera = calibrate_camera(spots, rig.board, rig.camera.shape, names.index(FLAT), names)
        spot_phases = tuple(measured for _, measured in found.values())
        if needs_spot_phases:
            check_spot_phases(spot_phases)
    try:
        point_spread = estimate_point_spread(spots, camera, rig.board)
    except InputError as error:
        _log.warning("measurements cannot be deconvolved: %s", error)
        point_spread = None
    return CalibrationData(
        identity=rig.identity,
        board=rig.board,
        procedure=rig.procedure,
        known=rig.uncertainty,
        run=run,
        exposures=max(exposures.values()),
        spots=spots,
        spot_phases=spot_phases,
        exposures_at_postures=np.array([exposures[name] for name in names]),
        missing=missing,
        camera=camera,
        point_spread=point_spread,
        phase_at_zero=np.full(rig.camera.shape, np.nan, dtype=np.float32),
        phases=np.empty((0, *rig.camera.shape), dtype=np.float32),
        readings_mm=np.empty(0),
    )


def _acquire_planes(data: CalibrationData, acquire: "_Acquirer", heights: np.ndarray) -> CalibrationData:
    """The same data with all planes, done or kept from before, but their phases, which stay in files."""
    # The blank side first lies where the printed one lay, before the stage moves: this is z = 0 of both.
    phase_at_zero, _ = acquire.plane(ZERO, 0.0)
    readings = [acquire.plane(f"{k:02d}", height)[1] for k, height in enumerate(heights)]
    return replace(
        data,
        exposures=max(data.exposures, acquire.exposures),
        phase_at_zero=phase_at_zero,
        readings_mm=np.array(readings),
    )


def measure(
    rig: Rig,
    calibration: Calibration,
    placement: Placement,
    brackets: Sequence[float] = (1.0,),
    filter_fwhm_px: float | None = None,
    deconvolve: bool = False,
) -> PointMap:
    """Measure one part.

    The stage goes to 0, the exposure is set for this part, and its fringes are captured, decoded and reconstructed.

    Parameters
    ----------
    rig : Rig
        Open.
    calibration : Calibration
        Of this rig.
    placement : Placement
    brackets : sequence of float
        Exposures to take and merge, as multiples of the automatic one: for shiny parts. Those beyond the camera's
        limits are left out, with a warning.
    filter_fwhm_px : float, optional
        Width of the Gaussian under which planes are fitted to the phasors; nothing is filtered unless it is given.
    deconvolve : bool
        Free the phase from the drag towards brighter neighbours: for metal and solder.

    Raises
    ------
    InputError
        If the calibration is of another rig or camera size, or shares its exposures with this measurement, or holds no
        point spread to deconvolve with.
    """
    phase_map = measure_phase(rig, calibration, placement, brackets)
    if deconvolve:
        phase_map = deconvolved(phase_map, calibration)
    if filter_fwhm_px is not None:
        phase_map = filter_phasors(phase_map, filter_fwhm_px)
    return reconstruct(phase_map, calibration)


def deconvolved(phase_map: PhaseMap, calibration: Calibration) -> PhaseMap:
    """A phase map freed from the drag of blur times brightness, with the calibration's point spread.

    Raises
    ------
    InputError
        If the calibration holds none.
    """
    if calibration.point_spread is None:
        raise InputError(
            "the calibration holds no point spread to deconvolve with: its postures showed too few spots, or all at "
            "one height; calibrate with more of them"
        )
    heights = reconstruct(phase_map, calibration).xyz[..., 2]
    return deconvolve_phasors(phase_map, calibration.point_spread, heights)


def measure_phase(
    rig: Rig, calibration: Calibration, placement: Placement, brackets: Sequence[float] = (1.0,)
) -> PhaseMap:
    """The phase map of one part, as `measure` takes it."""
    calibration.check_fits(rig.identity, rig.camera.shape)
    patterns = sequence_patterns(calibration.procedure, rig.projector.shape)
    frames, noise = capture_part(rig, placement, patterns, brackets)
    if frames.run == calibration.run and frames.serials.min() < calibration.exposures:
        raise InputError(
            f"exposure {frames.serials.min()} of run {frames.run!r} belongs to the calibration already: measure in a "
            "run of another name (--run)"
        )
    return decode_sequence(frames, calibration.procedure, noise)


def capture_part(
    rig: Rig, placement: Placement, patterns: np.ndarray, brackets: Sequence[float] = (1.0,)
) -> tuple[Frames, CameraNoise | GreyVariance | None]:
    """Frames of ``patterns`` (frames, rows, cols) on a part, exposed and merged as `measure` does.

    Beside them their noise, if anybody states it.
    """
    rig.operator.place(placement)
    rig.stage.move_to_mm(0.0)
    auto_exposure(rig)
    possible = possible_brackets(rig, brackets)
    if len(possible) < len(brackets):
        level = logging.WARNING if len(possible) == 1 else logging.INFO
        _log.log(level, "%s: only the brackets %s are within the camera's exposures", placement.part, possible)
    if possible == (1.0,):
        return rig.capture(patterns), rig.camera.noise
    merged = capture_bracketed(rig, patterns, possible)
    return merged.frames, merged.variance


def possible_brackets(rig: Rig, brackets: Sequence[float]) -> tuple[float, ...]:
    """Those of ``brackets``, multiples of the present exposure, that lie within the camera's limits."""
    low, high = rig.camera.exposure_limits_us
    return tuple(ratio for ratio in brackets if low <= ratio * rig.camera.exposure_us <= high)


def plane_heights(rig: Rig) -> np.ndarray:
    """Stage positions of the calibration planes in mm, from the lowest up: as listed, or evenly spaced about 0.

    Raises
    ------
    InputError
        If they are too few for any method, or do not lie within the stage's limits.
    """
    procedure = rig.procedure
    if procedure.planes < MIN_PLANES:
        raise InputError(
            f"a calibration with planes needs at least {MIN_PLANES} of them, and the rig file states "
            f"{procedure.planes}: raise procedure.planes, or calibrate by a method without planes"
        )
    if procedure.heights_mm:
        heights = np.array(procedure.heights_mm)
    else:
        heights = (np.arange(procedure.planes) - (procedure.planes - 1) / 2) * procedure.plane_step_mm
    low, high = rig.stage.limits_mm
    if heights[0] < low or heights[-1] > high:
        raise InputError(
            f"{procedure.planes} planes {procedure.plane_step_mm:g} mm apart reach from {heights[0]:g} to "
            f"{heights[-1]:g} mm, the stage only from {low:g} to {high:g} mm: change procedure.planes or "
            "procedure.plane_step_mm in the rig file"
        )
    return heights


def plane_phase(phase_map: PhaseMap) -> np.ndarray:
    """Absolute phase of a calibration plane where it counts, (rows, cols) float32 rad; NaN elsewhere.

    That is where the neighbours within ``RIM_PX`` are valid too; beyond the picture nothing is.
    """
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * RIM_PX + 1, 2 * RIM_PX + 1))
    valid = phase_map.valid.astype(np.uint8)
    inside = cv2.erode(valid, disc, borderType=cv2.BORDER_CONSTANT, borderValue=0).astype(bool)
    return np.where(inside, phase_map.absolute, np.nan).astype(np.float32)


def _postures(rig: Rig) -> list[tuple[str, Placement]]:
    count = rig.procedure.postures - 1
    names = rig.procedure.posture_names or [f"{k:02d}" for k in range(count)]
    tilted = [(names[k], Placement("board", posture=k)) for k in range(count)]
    return [*tilted, (FLAT, Placement("board"))]


def _check_found(names: Collection[str], missing: Collection[str]) -> None:
    if FLAT in missing or len(names) - len(missing) < MIN_POSTURES:
        raise InputError(
            f"the board was not found in posture {', '.join(missing)}: the flat one and at least {MIN_POSTURES} in all "
            "are needed; start again with the same command and lay it into the light, the other postures are kept"
        )


class _Acquirer:
    """Does the steps that are not done yet, each from the state in which the one before it ended."""

    def __init__(self, rig: Rig, unfinished: Unfinished, advance: Callable[[float], None]):
        self._rig = rig
        self._unfinished = unfinished
        self._advance = advance
        self._patterns = sequence_patterns(rig.procedure, rig.projector.shape)
        self._exposure_us: float | None = None
        self._exposed = False  # for the printed side
        self._blank_side_up = False
        self.exposures = 0

    def posture(self, name: str, placement: Placement) -> tuple[Spots, SpotPhases] | None:
        """Spots of the board in one posture and the phases at them; None where it was not found."""

        def take() -> dict[str, np.ndarray]:
            self._rig.operator.place(placement)
            self._rig.stage.move_to_mm(0.0)
            if not self._exposed:
                auto_exposure(self._rig)
            phase_map = self._capture()[1] if self._rig.procedure.fringes_on_postures else None
            try:
                spots = detect_spots(self._white() if phase_map is None else phase_map.background, self._rig.board)
                if spots.seen.sum() < MIN_SPOTS:
                    raise BoardNotFound(f"only {spots.seen.sum()} of its spots can be measured")
            except BoardNotFound as error:
                _log.warning("posture %s: the board was not found (%s)", name, error)
                return {}
            if phase_map is None:
                return asdict(spots) | asdict(no_spot_phases(spots))
            return asdict(spots) | asdict(measure_spot_phases(phase_map, spots, self._rig.board.dark_spots))

        arrays = self._once(f"posture-{name}", take)
        self._exposed = bool(arrays)
        if not arrays:
            return None
        found, measured = ({field.name: arrays[field.name] for field in fields(kind)} for kind in (Spots, SpotPhases))
        return Spots(**found), SpotPhases(**measured)

    def plane(self, name: str, height: float) -> tuple[np.ndarray, float]:
        """Absolute phase (rows, cols) of the blank side at one height, NaN where invalid, and the stage's reading."""

        def take() -> dict[str, np.ndarray]:
            if not self._blank_side_up:
                self._rig.operator.place(Placement("board", face=BLANK))
                self._blank_side_up = True
            self._rig.stage.move_to_mm(float(height))
            if name == ZERO:
                auto_exposure(self._rig)
            frames, phase_map = self._capture()
            return {
                "phase_rad": plane_phase(phase_map),
                "stage_position_mm": np.array(frames.stage_position_mm),
            }

        arrays = self._once(f"plane-{name}", take)
        return arrays["phase_rad"], float(arrays["stage_position_mm"])

    def _once(self, name: str, take: Callable[[], dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
        step = self._unfinished.step(name)
        if step is None:
            if self._exposure_us is not None:
                self._rig.camera.exposure_us = self._exposure_us
            arrays = take()
            step = Step(arrays, self._rig.camera.exposure_us, self.exposures)
            self._unfinished.finish(name, step)
        self._exposure_us, self.exposures = step.exposure_us, step.exposures
        self._advance(1)
        return dict(step.arrays)

    def _white(self) -> np.ndarray:
        """Grey values (rows, cols) above black, in white light."""
        frames = self._rig.capture(np.full_like(self._patterns[:1], 255))
        self.exposures = int(frames.serials[-1]) + 1
        return frames.stack[0] - np.float32(frames.black_level_dn)

    def _capture(self) -> tuple[Frames, PhaseMap]:
        frames = self._rig.capture(self._patterns)
        self.exposures = int(frames.serials[-1]) + 1
        return frames, decode_sequence(frames, self._rig.procedure, self._rig.camera.noise)
