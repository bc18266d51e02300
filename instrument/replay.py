"""Replays a recording through the contract: the same questions get the same answers, bit by bit.

A capture is found by what was asked: the placement, where the stage was sent, which exposure was set, which patterns
were projected, and how often the same had been asked before.
"""

from collections import Counter, defaultdict
from collections.abc import Hashable, Sequence
from pathlib import Path
from typing import Generic, Self, TypeVar

import numpy as np

from . import hdf5
from .contract import CameraNoise, DeviceReport, Frames, KnownUncertainty, Placement, Procedure, RigIdentity, SpotBoard
from .errors import InputError
from .journal import (
    KIND,
    VERSION,
    Captured,
    Event,
    Exposed,
    Moved,
    RigDescription,
    capture_group,
    description_from_json,
    events_from_json,
    patterns_sha256,
)
from .limits import check_patterns, check_within

_SHOWN = 4  # captures named in the sentence that says what a recording holds instead

_Question = TypeVar("_Question", bound=Hashable)
_Answer = TypeVar("_Answer")


def open_recording(path: str | Path, exposures_done: int = 0) -> "Replay":
    """Open a recording as a rig.

    Frames are read and verified one capture at a time; damage in them is reported by the capture that needs them.

    Parameters
    ----------
    path : str or Path
    exposures_done : int
        What was recorded up to the capture with the serial before this one counts as asked already, so that an
        interrupted run goes on behind it.

    Raises
    ------
    InputError
        When there is no such file, or it is damaged, truncated or not a recording.
    """
    path = Path(path)
    with hdf5.read(path, KIND, VERSION) as file:
        description = description_from_json(hdf5.get_text(file, "rig"), str(path))
        events = events_from_json(hdf5.get_text(file, "journal"), str(path))
        captures = [number for number, event in enumerate(events) if isinstance(event, Captured)]
        asked = 0
        if exposures_done > 0:
            for index, number in enumerate(captures):
                if hdf5.get(file, f"{capture_group(index)}/serials")[-1] < exposures_done:
                    asked = number + 1
    return Replay(path, description, events, asked)


class Replay:
    """A rig that was recorded; ``open_recording`` makes it.

    Parameters
    ----------
    path : Path
    description : RigDescription
    events : sequence of Event
    asked : int
        How many of the events count as asked already.
    """

    def __init__(self, path: Path, description: RigDescription, events: Sequence[Event], asked: int):
        self.path = path
        self.captures = tuple(event for event in events if isinstance(event, Captured))
        self.operator = _ReplayOperator(path, self.captures)
        self.stage = _ReplayStage(description)
        self.camera = _ReplayCamera(description)
        self.projector = _ReplayProjector(description.projector_shape)
        self._description = description
        self._answers: _Answers[tuple, int] = _Answers()
        index = 0
        for number, event in enumerate(events):
            if isinstance(event, Captured):
                question = _question(event.placement, event.target_mm, event.target_us, event.patterns_sha256)
                self._answers.add(question, index, asked=number < asked)
                index += 1
            elif isinstance(event, Moved):
                self.stage.readings.add(_rounded_mm(event.target_mm), event.reported_mm, asked=number < asked)
            elif isinstance(event, Exposed):
                self.camera.readings.add(_rounded_us(event.target_us), event.reported_us, asked=number < asked)

    @property
    def identity(self) -> RigIdentity:
        return self._description.identity

    @property
    def devices(self) -> tuple[DeviceReport, ...]:
        return ()

    @property
    def board(self) -> SpotBoard:
        return self._description.board

    @property
    def procedure(self) -> Procedure:
        return self._description.procedure

    @property
    def uncertainty(self) -> KnownUncertainty:
        return self._description.uncertainty

    def capture(self, patterns: np.ndarray) -> Frames:
        """The frames that were recorded for these patterns in the present state.

        Raises
        ------
        InputError
            When nothing, or nothing more, was recorded for it, or when the frames are damaged.
        """
        check_patterns(patterns, self.projector.shape)
        placement, target_mm, target_us = self.operator.placement, self.stage.target_mm, self.camera.target_us
        index = self._answers.next(_question(placement, target_mm, target_us, patterns_sha256(patterns)))
        if index is None:
            raise InputError(self._missing(len(patterns)))
        return self.frames(index)

    def frames(self, index: int) -> Frames:
        """The frames of the capture with this number, in the order of recording.

        Raises
        ------
        InputError
            When they are damaged.
        """
        event, group = self.captures[index], capture_group(index)
        with hdf5.read(self.path, KIND, VERSION) as file:
            return Frames(
                stack=hdf5.get(file, f"{group}/stack"),
                full_scale_dn=event.full_scale_dn,
                black_level_dn=event.black_level_dn,
                exposure_us=event.exposure_us,
                gain_db=event.gain_db,
                stage_position_mm=event.stage_position_mm,
                serials=hdf5.get(file, f"{group}/serials"),
                times_s=hdf5.get(file, f"{group}/times_s"),
                run=event.run,
            )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        return None

    def _missing(self, count: int) -> str:
        placement, target_mm, target_us = self.operator.placement, self.stage.target_mm, self.camera.target_us
        held = Counter((c.target_mm, c.target_us) for c in self.captures if c.placement == placement)
        nearest = sorted(held, key=lambda state: (abs(state[0] - target_mm), abs(state[1] - target_us)))[:_SHOWN]
        shown = ", ".join(f"{z:g} mm and {us:g} us ({held[z, us]} captures)" for z, us in nearest)
        return (
            f"recording {self.path} holds no further capture of {_name(placement)} at {target_mm:g} mm and "
            f"{target_us:g} us with these {count} patterns; the nearest it has of it: {shown or 'none'}"
        )


class _Answers(Generic[_Question, _Answer]):
    """Recorded answers by question, each given once and in the order of recording."""

    def __init__(self) -> None:
        self._recorded: defaultdict[_Question, list[_Answer]] = defaultdict(list)
        self._asked: Counter[_Question] = Counter()

    def add(self, question: _Question, answer: _Answer, asked: bool) -> None:
        self._recorded[question].append(answer)
        self._asked[question] += asked

    def next(self, question: _Question) -> _Answer | None:
        """The next answer; None where none is left."""
        answers, count = self._recorded.get(question, []), self._asked[question]
        if count >= len(answers):
            return None
        self._asked[question] += 1
        return answers[count]


class _ReplayOperator:
    def __init__(self, path: Path, captures: Sequence[Captured]):
        self.placement: Placement | None = None
        self._path = path
        self._known = dict.fromkeys(capture.placement for capture in captures)

    def place(self, placement: Placement) -> None:
        """Raises InputError when nothing was captured of it."""
        if placement not in self._known:
            parts = ", ".join(dict.fromkeys(_name(known) for known in self._known)) or "nothing"
            raise InputError(f"recording {self._path} holds no capture of {_name(placement)}; it holds {parts}")
        self.placement = placement


class _ReplayStage:
    def __init__(self, description: RigDescription):
        self.limits_mm = description.stage_limits_mm
        self.readings: _Answers[float, float] = _Answers()
        self.target_mm = self.position_mm = description.stage_position_mm

    def move_to_mm(self, position: float) -> None:
        """To a height that was never recorded the stage goes too: only a capture there has no answer."""
        check_within(position, self.limits_mm, "stage position", "mm")
        reading = self.readings.next(_rounded_mm(position))
        self.target_mm = float(position)
        self.position_mm = self.target_mm if reading is None else reading


class _ReplayCamera:
    def __init__(self, description: RigDescription):
        self.shape: tuple[int, int] = description.camera_shape
        self.full_scale_dn: float = description.full_scale_dn
        self.black_level_dn: float = description.black_level_dn
        self.noise: CameraNoise | None = description.noise
        self.exposure_limits_us = description.exposure_limits_us
        self.readings: _Answers[float, float] = _Answers()
        self.target_us = self._reported_us = description.exposure_us

    @property
    def exposure_us(self) -> float:
        return self._reported_us

    @exposure_us.setter
    def exposure_us(self, value: float) -> None:
        check_within(value, self.exposure_limits_us, "exposure time", "us")
        reading = self.readings.next(_rounded_us(value))
        self.target_us = float(value)
        self._reported_us = self.target_us if reading is None else reading


class _ReplayProjector:
    def __init__(self, shape: tuple[int, int]):
        self.shape = shape


def _question(placement: Placement | None, target_mm: float, target_us: float, patterns: str) -> tuple:
    return placement, _rounded_mm(target_mm), _rounded_us(target_us), patterns


def _rounded_mm(target: float) -> float:
    """To 1 nm: below what a stage resolves, above what another machine's rounding changes."""
    return round(float(target), 6)


def _rounded_us(target: float) -> float:
    """To 1 ns: below what a camera resolves, above what another machine's rounding changes."""
    return round(float(target), 3)


def _name(placement: Placement | None) -> str:
    if placement is None:
        return "an empty table"
    posture = "" if placement.posture is None else f" in posture {placement.posture}"
    face = "" if placement.face == "printed" else f" on its {placement.face} face"
    made_of = "" if placement.material is None else f" of {placement.material}"
    return f"{placement.part}{made_of}{posture}{face}"
