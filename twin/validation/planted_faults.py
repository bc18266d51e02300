"""Faults that are planted in recordings of a twin, one at a time, and what `diagnose` says of each.

Some are settings of the twin; others are done to a sound twin by a rig that stands before it: a stage that slips, a
board that is exchanged, frames that come in another order, a glint. What is diagnosed is the recording alone.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np

from greenough.instrument.contract import BLANK, Frames, Placement, Rig
from greenough.instrument.journal import patterns_sha256
from greenough.instrument.recording import record
from greenough.pipeline.acquisition import calibrate, plane_heights
from greenough.pipeline.diagnosis.finding import Finding, worst_first
from greenough.pipeline.diagnosis.recordings import diagnose_recording
from greenough.pipeline.exposure import auto_exposure
from greenough.pipeline.fringes import FringeSet

from ..rig import open as open_twin

COARSE = ("camera.rows=240", "camera.cols=320", "twin.optics.camera_focal_px=5670.75", "twin.render.nodes=16")
"""The whole field in coarse pixels."""

COARSE_CALIBRATION = (
    "camera.rows=360", "camera.cols=480", "twin.optics.camera_focal_px=8506.125", "board.small_diameter_mm=0.3",
    "board.big_diameter_mm=0.5", "procedure.postures=8", "procedure.planes=12", "procedure.plane_step_mm=0.25",
)  # fmt: skip
"""The same with pixels in which spots are found, and a short calibration."""

SLIP_MM = 0.05
DEFOCUS_MM = 1.0

Change = Callable[[np.random.Generator, Rig], "Changes"]


@dataclass(frozen=True)
class Changes:
    """What stands between a rig and who uses it.

    Parameters
    ----------
    place : callable
        What is really laid down for a placement.
    height : callable
        Where the stage really goes for a position, mm, when this placement lies there.
    frames : callable
        What is seen for the frames of a capture with this number.
    """

    place: Callable[[Placement], Placement] = lambda placement: placement
    height: Callable[[Placement | None, float], float] = lambda placement, position: position
    frames: Callable[[int, Frames], Frames] = lambda number, frames: frames


@dataclass(frozen=True)
class Fault:
    """One fault, and by which name it must be found.

    Parameters
    ----------
    finding : str
        Name of the finding; empty for none.
    shown : str
        In what it is planted: ``"parts"``, a plane and a coin; ``"planes"``, the board's blank side at the heights of a
        calibration; ``"calibration"``.
    settings : tuple of str
        Of the twin.
    change : callable
        Draws what is changed.
    """

    finding: str
    shown: Literal["parts", "planes", "calibration"]
    settings: tuple[str, ...] = ()
    change: Change = lambda rng, rig: Changes()


def _swapped(rng: np.random.Generator, rig: Rig) -> Changes:
    of_capture = int(rng.integers(2))
    first, second = sorted(rng.choice(sum(rig.procedure.steps), 2, replace=False))

    def frames(number: int, seen: Frames) -> Frames:
        if number != of_capture:
            return seen
        stack = seen.stack.copy()
        stack[[first, second]] = stack[[second, first]]
        return replace(seen, stack=stack)

    return Changes(frames=frames)


def _glint(rng: np.random.Generator, rig: Rig) -> Changes:
    rows, cols = rig.camera.shape
    v, u = np.mgrid[:rows, :cols]
    middle_v, middle_u = rng.uniform(0.35, 0.65, 2) * (rows, cols)
    distance = np.hypot(v - middle_v, u - middle_u) / (0.02 * cols)
    gain = 1 + 5 * np.exp(-(distance**2) / 2)
    black, full = rig.camera.black_level_dn, rig.camera.full_scale_dn

    def frames(number: int, seen: Frames) -> Frames:
        light = black + gain * (seen.stack - black)
        return replace(seen, stack=np.clip(np.rint(light), 0, full).astype(seen.stack.dtype))

    return Changes(frames=frames)


def _slip(rng: np.random.Generator, rig: Rig) -> Changes:
    """On the way up, before one of the planes; before the last it would be no slip but one wrong reading."""
    planes, step = rig.procedure.planes, rig.procedure.plane_step_mm
    first = (int(rng.integers(2, planes - 1)) - (planes - 1) / 2 - 0.5) * step
    moves: list[float] = []

    def height(placement: Placement | None, position: float) -> float:
        if placement is None or placement.face != BLANK:
            return position
        moves.append(position)
        return position + SLIP_MM * (position > first and min(moves) < first)

    return Changes(height=height)


def _other_board(rng: np.random.Generator, rig: Rig) -> Changes:
    """Of the same make: only its print differs."""
    posture = int(rng.integers(rig.procedure.postures - 1))

    def place(placement: Placement) -> Placement:
        return replace(placement, part="second-board") if placement.posture == posture else placement

    return Changes(place=place)


def _defocus(rng: np.random.Generator, rig: Rig) -> Changes:
    """All that is laid under the microscope lies too high, or too low."""
    off = DEFOCUS_MM * rng.choice([-1, 1])
    return Changes(height=lambda placement, position: position + off)


FAULTS: Mapping[str, Fault] = {
    "clean measurement": Fault("", "parts"),
    "clean calibration": Fault("", "calibration"),
    "gamma 1.8": Fault("response", "parts", ("twin.optics.gamma=1.8",)),
    "saturated highlight": Fault("saturation", "parts", (), _glint),
    "two frames swapped": Fault("frame order", "parts", (), _swapped),
    "vibration of 3 um": Fault("vibration", "parts", ("twin.stability.vibration_um=3",)),
    "stage slip of 50 um": Fault("stage slip", "calibration", (), _slip),
    "one posture of another board": Fault("another board", "calibration", (), _other_board),
    "defocus of 1 mm": Fault(
        "defocus",
        "planes",
        ("stage.min_mm=-3", "stage.max_mm=3", "procedure.planes=12", "procedure.plane_step_mm=0.25"),
        _defocus,
    ),
}


@dataclass(frozen=True)
class Outcome:
    """What was found for one fault of one instrument.

    Parameters
    ----------
    fault : str
    seed : int
    rank : int
        Of the planted fault among the findings, from 1; 0 where it is not among them.
    found : tuple of Finding
        Worst first.
    """

    fault: str
    seed: int
    rank: int
    found: tuple[Finding, ...]

    @property
    def as_it_should(self) -> bool:
        """The fault first, or nothing where nothing was planted."""
        return self.rank == 1 if FAULTS[self.fault].finding else not self.found


def diagnosed(fault: str, seed: int, path: Path) -> Outcome:
    """What is said of a recording that `record_fault` made."""
    found = tuple(worst_first(diagnose_recording(path).findings))
    names = [finding.name for finding in found]
    wanted = FAULTS[fault].finding
    return Outcome(fault, seed, names.index(wanted) + 1 if wanted in names else 0, found)


def record_fault(fault: str, seed: int, path: Path, seen: dict[tuple, Frames] | None = None) -> None:
    """Record a calibration, or measurements of a plane and a coin, with this fault.

    Parameters
    ----------
    fault : str
        Of `FAULTS`.
    seed : int
        Of the twin and of what the fault draws.
    path : Path
        The recording to write.
    seen : dict, optional
        Captures of faults of the same seed without settings of their own: what is seen again is not rendered again.

    Raises
    ------
    InputError
        If the twin cannot be calibrated.
    """
    planted = FAULTS[fault]
    settings = COARSE_CALIBRATION if planted.shown == "calibration" else COARSE
    rig, _ = open_twin("twin", [*settings, f"twin.seed={seed}", *planted.settings], f"diagnosed {fault}")
    rng = np.random.default_rng([seed, sorted(FAULTS).index(fault)])
    kept = {} if seen is None or planted.settings else seen
    with record(cast(Rig, FaultyRig(rig, planted.change(rng, rig), kept)), path) as recorded:
        if planted.shown == "calibration":
            calibrate(recorded, path.with_suffix(".calibration.h5"))
            path.with_suffix(".calibration.h5").unlink()
            return
        fringes = FringeSet(recorded.procedure.periods_px, recorded.procedure.steps)
        patterns = fringes.patterns(*recorded.projector.shape)
        planes = planted.shown == "planes"
        for placement in [Placement("board", face=BLANK)] if planes else [Placement("plane"), Placement("coin")]:
            recorded.operator.place(placement)
            recorded.stage.move_to_mm(0.0)
            auto_exposure(recorded)
            for height in plane_heights(recorded) if planes else [0.0]:
                recorded.stage.move_to_mm(float(height))
                recorded.capture(patterns)


class FaultyRig:
    """A rig with changes before it, of which whoever uses it sees nothing."""

    def __init__(self, rig: Rig, changes: Changes, seen: dict[tuple, Frames]):
        self._rig = rig
        self._changes = changes
        self._seen = seen
        self._laid: Placement | None = None
        self._height = rig.stage.position_mm
        self._serial = 0
        self._sequences = 0
        self._placement: Placement | None = None
        self.stage = self
        self.operator = self
        self.position_mm = rig.stage.position_mm

    def __getattr__(self, name: str) -> Any:
        return getattr(self._rig, name)

    @property
    def limits_mm(self) -> tuple[float, float]:
        """Of the stage."""
        return self._rig.stage.limits_mm

    def place(self, placement: Placement) -> None:
        """As an operator does."""
        self._placement = placement
        self._laid = self._changes.place(placement)
        self._rig.operator.place(self._laid)

    def move_to_mm(self, position: float) -> None:
        """As a stage does, which then reads what it was told."""
        self._height = self._changes.height(self._placement, position)
        self._rig.stage.move_to_mm(self._height)
        self.position_mm = float(position)

    def capture(self, patterns: np.ndarray) -> Frames:
        """As a rig does."""
        state = (
            self._rig.camera.shape,
            self._laid,
            self._height,
            self._rig.camera.exposure_us,
            patterns_sha256(patterns),
        )
        if state not in self._seen:
            self._seen[state] = self._rig.capture(patterns)
        serials = self._serial + np.arange(len(patterns))
        self._serial += len(patterns)
        frames = replace(self._seen[state], stage_position_mm=self.position_mm, serials=serials)
        if len(patterns) == 1:
            return frames
        self._sequences += 1
        return self._changes.frames(self._sequences - 1, frames)

    def __enter__(self) -> "FaultyRig":
        self._rig.__enter__()
        return self

    def __exit__(self, *error: Any) -> None:
        self._rig.__exit__(*error)


def outcome_table(outcomes: Sequence[Outcome]) -> str:
    """Faults by seeds: the rank of the planted fault, ``-`` where it was not found, and the runner-up's name.

    Of sound recordings, the number of findings. The last column counts what is as it should be.
    """
    seeds = sorted({outcome.seed for outcome in outcomes})
    rows = [["fault", *map(str, seeds), "sound"]]
    for fault in FAULTS:
        of_fault = {outcome.seed: outcome for outcome in outcomes if outcome.fault == fault}
        cells = [_cell(of_fault[seed]) if seed in of_fault else "" for seed in seeds]
        rows.append([fault, *cells, str(sum(outcome.as_it_should for outcome in of_fault.values()))])
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    return "\n".join("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)) for row in rows)


def _cell(outcome: Outcome) -> str:
    wanted = FAULTS[outcome.fault].finding
    others = [finding.name for finding in outcome.found if finding.name != wanted]
    if not wanted:
        return f"{len(outcome.found)}" + (f" ({others[0]})" if others else "")
    return (str(outcome.rank) if outcome.rank else "-") + (f" ({others[0]})" if others else "")
