"""What a recording shows: each of its fringe sequences and, where it is one of a calibration, the calibration."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, cast

import numpy as np

from greenough.instrument.contract import BLANK, PRINTED, Frames, Placement, Rig
from greenough.instrument.errors import FileError, InputError
from greenough.instrument.journal import Captured, patterns_sha256
from greenough.instrument.replay import Replay, open_recording

from ..acquisition import calibrate
from ..calibration import Calibration
from ..camera_calibration import MIN_POSTURES
from ..fringes import FringeSet
from ..phase_height import MIN_PLANES
from ..reconstruct import reconstruct
from .calibrations import diagnose_calibration, yardstick_of
from .finding import LEAST_UM, Finding, Yardstick
from .focus import check_focus_range, contrast_map
from .sequence import Sequence, sequence_of
from .sequences import findings_of
from .stage_readings import check_stage
from .swapped_frames import Order, find_order, rearranged

_SCALE_CAPTURES = 4  # planes from which the scale is taken where nothing was calibrated

Advance = Callable[[float], None]


@dataclass(frozen=True, eq=False)
class RecordingDiagnosis:
    """Findings, in no order, and what they rest on.

    Parameters
    ----------
    findings : list of Finding
    sequences : int
        How many fringe sequences were looked at.
    yardstick : Yardstick
    """

    findings: list[Finding]
    sequences: int
    yardstick: Yardstick


def count_sequences(path: Path, fringes: FringeSet | None) -> int:
    """How often `diagnose_recording` calls ``advance``."""
    replay = open_recording(path)
    return 2 * len(_fringed(replay, fringes or _own_fringes(replay)))


def diagnose_recording(
    path: Path,
    fringes: FringeSet | None = None,
    calibration: Calibration | None = None,
    advance: Advance = lambda steps: None,
) -> RecordingDiagnosis:
    """Everything that a recording shows.

    Parameters
    ----------
    path : Path
    fringes : FringeSet, optional
        What was projected, where it is not the rig's own procedure.
    calibration : Calibration, optional
        Tells the scale of heights where the recording does not.
    advance : callable
        Called with 1, `count_sequences` times.

    Raises
    ------
    InputError
        If the recording is damaged, or holds no sequence of these fringes.
    """
    replay = open_recording(path)
    fringes = fringes or _own_fringes(replay)
    captures = _fringed(replay, fringes)
    if not captures:
        raise InputError(
            f"recording {path} holds no fringes with the periods {fringes.periods} in {fringes.steps} steps: give "
            "those that were projected by --periods and --steps"
        )
    orders: dict[int, Order] = {}
    for index in captures:
        order = find_order(_sequence(replay, index, fringes))
        if order is not None:
            orders[index] = order
        advance(1)
    findings: list[Finding] = []
    own: Calibration | None = None
    if _is_calibration(replay, captures):
        try:
            own = _calibrated(replay, orders)
        except FileError:
            raise
        except InputError as error:
            findings.append(_refused(str(error)))
    known = own or calibration
    if known is not None:
        yardstick = yardstick_of(known)
    else:
        yardstick = Yardstick(_scale(replay, captures, orders, fringes), _least_um(replay))
    faces = _Faces()
    for index in captures:
        sequence = _sequence(replay, index, fringes)
        order = orders.get(index)
        findings += findings_of(sequence, order, yardstick)
        sound = rearranged(sequence, order)
        if _is_plane(replay.captures[index]) and sound is not None:
            faces.add(replay.captures[index], sound, own)
        advance(1)
    findings += faces.findings(yardstick)
    if own is not None:
        findings += diagnose_calibration(own)
    return RecordingDiagnosis(findings, len(captures), yardstick)


@dataclass
class _Faces:
    """The blank side at the stage's heights."""

    readings_mm: list[float] = field(default_factory=list)
    heights_mm: list[np.ndarray] = field(default_factory=list)
    contrasts: list[np.ndarray] = field(default_factory=list)
    sigmas_rad: list[float] = field(default_factory=list)

    def add(self, capture: Captured, sequence: Sequence, calibration: Calibration | None) -> None:
        self.readings_mm.append(capture.stage_position_mm)
        self.contrasts.append(contrast_map(sequence))
        self.sigmas_rad.append(sequence.sigma_rad)
        if calibration is not None:
            self.heights_mm.append(reconstruct(sequence.decoded, calibration).xyz[..., 2].astype(np.float32))

    def findings(self, yardstick: Yardstick) -> Iterator[Finding]:
        readings = np.array(self.readings_mm)
        if len(set(readings)) < 2:
            return
        common = np.isfinite(self.contrasts).all(axis=0)
        if common.any():
            contrasts = np.array([each[common].mean() for each in self.contrasts])
            sigma = float(np.median(self.sigmas_rad))
            yield from check_focus_range(readings, contrasts, sigma, "planes", yardstick)
        if len(self.heights_mm) == len(readings):
            planes = np.array(self.heights_mm[1:])  # before them the blank side is shown at stage position 0
            seen = np.isfinite(planes).all(axis=0)
            if seen.any():
                yield from check_stage(readings[1:], planes[:, seen].mean(axis=1), yardstick)


@dataclass(frozen=True)
class _InOrder:
    """A recorded rig whose frames are in the order that was found."""

    replay: Replay
    orders: Mapping[int, Order]  # by the first serial of their capture

    def __getattr__(self, name: str) -> Any:
        return getattr(self.replay, name)

    def capture(self, patterns: np.ndarray) -> Frames:
        frames = self.replay.capture(patterns)
        order = self.orders.get(int(frames.serials[0]))
        stack = None if order is None else order.rearranged(frames.stack)
        return frames if stack is None else replace(frames, stack=stack)


def _own_fringes(replay: Replay) -> FringeSet:
    return FringeSet.of(replay.procedure)


def _fringed(replay: Replay, fringes: FringeSet) -> list[int]:
    """Numbers of the captures that show these fringes."""
    try:
        digest = patterns_sha256(fringes.patterns(*replay.projector.shape))
    except InputError:
        digest = ""  # these fringes have a field that the projector exceeds: only their number can tell
    of_them = [k for k, capture in enumerate(replay.captures) if capture.patterns_sha256 == digest]
    if of_them:
        return of_them
    return [k for k in range(len(replay.captures)) if len(replay.frames(k).stack) == fringes.frame_count]


def _sequence(replay: Replay, index: int, fringes: FringeSet) -> Sequence:
    capture = replay.captures[index]
    level = capture.placement is not None and (capture.placement.part == "plane" or capture.placement.face == BLANK)
    return sequence_of(_name(index, capture), replay.frames(index), fringes, replay.camera.noise, quiet=level)


def _name(index: int, capture: Captured) -> str:
    placement = capture.placement
    if placement is None:
        return f"capture {index}"
    posture = "" if placement.posture is None else f", posture {placement.posture:02d}"
    face = ", blank side" if placement.face == BLANK else ""
    return f"capture {index} ({placement.part}{posture}{face}, {capture.target_mm:g} mm)"


def _is_plane(capture: Captured) -> bool:
    return capture.placement is not None and capture.placement.face == BLANK


def _is_calibration(replay: Replay, captures: list[int]) -> bool:
    """Whether the board was shown flat and in enough postures, and its blank side at enough heights."""
    shown = [replay.captures[k] for k in captures]
    tilted = {each.placement.posture for each in shown if each.placement and each.placement.posture is not None}
    flat = any(each.placement == Placement("board", face=PRINTED) for each in shown)
    return flat and len(tilted) >= MIN_POSTURES - 1 and sum(map(_is_plane, shown)) > MIN_PLANES


def _calibrated(replay: Replay, orders: Mapping[int, Order]) -> Calibration:
    by_serial = {int(replay.frames(index).serials[0]): order for index, order in orders.items()}
    rig = cast(Rig, _InOrder(open_recording(replay.path), by_serial))
    with TemporaryDirectory() as folder:
        return calibrate(rig, Path(folder) / "calibration.h5", "diagnose")


def _refused(reason: str) -> Finding:
    return Finding(
        name="no calibration",
        where="calibration",
        effect_rad=2 * np.pi,
        effect_um=None,
        cause=f"this recording does not calibrate: {reason}",
        remedy="do what the sentence says, and see the other findings",
        evidence={},
    )


def _least_um(replay: Replay) -> float:
    return max(1e3 * replay.uncertainty.table_drift_mm, 1e-3) if replay.uncertainty.table_drift_mm else LEAST_UM


def _scale(replay: Replay, captures: list[int], orders: Mapping[int, Order], fringes: FringeSet) -> float | None:
    """Height by a radian of the finest phase, µm, from the same part at several readings; None where there are none."""
    of_part: dict[Placement, list[int]] = {}
    for index in captures:
        placement = replay.captures[index].placement
        if placement is not None and placement.posture is None:
            of_part.setdefault(placement, []).append(index)
    for same in of_part.values():
        by_height = {replay.captures[index].stage_position_mm: index for index in same}
        heights = sorted(by_height)
        if len(heights) < 2:
            continue
        chosen = heights[:: max(1, len(heights) // _SCALE_CAPTURES)]
        sound = [rearranged(_sequence(replay, by_height[z], fringes), orders.get(by_height[z])) for z in chosen]
        phases = np.array([np.nan if each is None else each.decoded.absolute for each in sound])
        slopes = np.diff(phases, axis=0) / np.diff(chosen)[:, None, None]
        if np.isfinite(slopes).any():
            return float(1e3 / np.median(np.abs(slopes[np.isfinite(slopes)])))
    return None
