"""Records a rig: the same contract in front, and everything that passes through it in one HDF5 file.

The file holds the rig's description (``rig``), each capture's frames (``captures/NNNNNN``: ``stack``, ``serials``,
``times_s``) and the order of what was asked (``journal``). It takes its name when the context is left without an
exception; otherwise nothing is left. Captures are written one by one as they come.
"""

from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Self

import h5py
import numpy as np

from . import hdf5
from .contract import (
    Camera,
    CameraNoise,
    DeviceReport,
    Frames,
    KnownUncertainty,
    Operator,
    Placement,
    Procedure,
    Projector,
    Rig,
    RigIdentity,
    SpotBoard,
    Stage,
)
from .errors import InputError
from .journal import (
    KIND,
    VERSION,
    Captured,
    Event,
    Exposed,
    Moved,
    Placed,
    capture_group,
    describe,
    patterns_sha256,
    to_json,
)


def record(rig: Rig, path: str | Path) -> Rig:
    """A rig that behaves as ``rig`` and records to ``path``, from entering its context to leaving it.

    The stage is read once after each move, and that reading stands until the next move.

    Raises
    ------
    InputError
        When ``path`` does not end in ``.h5``, and on entering when it cannot be written.
    """
    if Path(path).suffix != ".h5":
        raise InputError(f"recording {path}: the name must end in .h5, by which a recording is known from a rig file")
    return _RecordedRig(rig, Path(path))


class _Tape:
    """The file being written and the state that says what a capture shows."""

    def __init__(self, rig: Rig, file: h5py.File):
        self.file = file
        description = describe(rig)
        self.events: list[Event] = []
        self.captures = 0
        self.placement: Placement | None = None
        self.target_mm = self.reported_mm = description.stage_position_mm
        self.target_us = description.exposure_us
        hdf5.put(file, "rig", to_json(description), units="UTF-8 JSON")

    def placed(self, placement: Placement) -> None:
        self.placement = placement
        self.events.append(Placed(placement))

    def moved(self, target_mm: float, reported_mm: float) -> None:
        self.target_mm, self.reported_mm = target_mm, reported_mm
        self.events.append(Moved(target_mm, reported_mm))

    def exposed(self, target_us: float, reported_us: float) -> None:
        self.target_us = target_us
        self.events.append(Exposed(target_us, reported_us))

    def captured(self, patterns: np.ndarray, frames: Frames) -> None:
        group = capture_group(self.captures)
        hdf5.put(self.file, f"{group}/stack", frames.stack, units="DN")
        hdf5.put(self.file, f"{group}/serials", frames.serials, units="1")
        hdf5.put(self.file, f"{group}/times_s", frames.times_s, units="s")
        self.captures += 1
        self.events.append(
            Captured(
                placement=self.placement,
                target_mm=self.target_mm,
                target_us=self.target_us,
                patterns_sha256=patterns_sha256(patterns),
                full_scale_dn=float(frames.full_scale_dn),
                black_level_dn=float(frames.black_level_dn),
                exposure_us=float(frames.exposure_us),
                gain_db=float(frames.gain_db),
                stage_position_mm=float(frames.stage_position_mm),
                run=frames.run,
            )
        )

    def finish(self) -> None:
        hdf5.put(self.file, "journal", to_json(self.events), units="UTF-8 JSON")


class _RecordedRig:
    def __init__(self, rig: Rig, path: Path):
        self._rig = rig
        self._path = path
        self._open = ExitStack()
        self._tape: _Tape | None = None

    @property
    def tape(self) -> _Tape:
        if self._tape is None:
            raise RuntimeError("a recorded rig works inside its context only: with record(rig, path) as rig")
        return self._tape

    @property
    def identity(self) -> RigIdentity:
        return self._rig.identity

    @property
    def devices(self) -> tuple[DeviceReport, ...]:
        return self._rig.devices

    @property
    def board(self) -> SpotBoard:
        return self._rig.board

    @property
    def procedure(self) -> Procedure:
        return self._rig.procedure

    @property
    def uncertainty(self) -> KnownUncertainty:
        return self._rig.uncertainty

    @property
    def projector(self) -> Projector:
        return self._rig.projector

    @property
    def camera(self) -> Camera:
        return _RecordedCamera(self._rig.camera, self.tape)

    @property
    def stage(self) -> Stage:
        return _RecordedStage(self._rig.stage, self.tape)

    @property
    def operator(self) -> Operator:
        return _RecordedOperator(self._rig.operator, self.tape)

    def capture(self, patterns: np.ndarray) -> Frames:
        frames = self._rig.capture(patterns)
        self.tape.captured(patterns, frames)
        return frames

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            # The file first: a path that cannot be written is refused before the rig is touched.
            file = stack.enter_context(hdf5.create(self._path, KIND, VERSION))
            stack.enter_context(self._rig)
            self._tape = _Tape(self._rig, file)
            self._open = stack.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        tape, self._tape = self.tape, None
        if kind is None:
            self._open.callback(tape.finish)
        self._open.__exit__(kind, error, traceback)


class _RecordedCamera:
    def __init__(self, camera: Camera, tape: _Tape):
        self._camera = camera
        self._tape = tape

    @property
    def shape(self) -> tuple[int, int]:
        return self._camera.shape

    @property
    def full_scale_dn(self) -> float:
        return self._camera.full_scale_dn

    @property
    def black_level_dn(self) -> float:
        return self._camera.black_level_dn

    @property
    def noise(self) -> CameraNoise | None:
        return self._camera.noise

    @property
    def exposure_limits_us(self) -> tuple[float, float]:
        return self._camera.exposure_limits_us

    @property
    def exposure_us(self) -> float:
        return self._camera.exposure_us

    @exposure_us.setter
    def exposure_us(self, value: float) -> None:
        self._camera.exposure_us = value
        self._tape.exposed(float(value), float(self._camera.exposure_us))


class _RecordedStage:
    def __init__(self, stage: Stage, tape: _Tape):
        self._stage = stage
        self._tape = tape

    @property
    def limits_mm(self) -> tuple[float, float]:
        return self._stage.limits_mm

    @property
    def position_mm(self) -> float:
        return self._tape.reported_mm

    def move_to_mm(self, position: float) -> None:
        self._stage.move_to_mm(position)
        self._tape.moved(float(position), float(self._stage.position_mm))


class _RecordedOperator:
    def __init__(self, operator: Operator, tape: _Tape):
        self._operator = operator
        self._tape = tape

    def place(self, placement: Placement) -> None:
        self._operator.place(placement)
        self._tape.placed(placement)
