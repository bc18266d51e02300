"""Whole calibrations over the wire, of which one thing goes wrong: what is raised, what is lit, what is left.

All devices of ``EmulatedRig`` are there, around a scene of plain geometry. What passes on the wires is counted, and a
fault strikes when a certain one of these events has come and before it is answered.
"""

import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Self
from unittest import mock

import numpy as np
from emulated_gige import free_address
from plain_scene import SETTINGS, STEPS, PlainScene, largest_error_um

from greenough.instrument import open_rig
from greenough.instrument.contract import Placement, Rig
from greenough.instrument.device_errors import DeviceError
from greenough.instrument.errors import InputError
from greenough.instrument.lightcrafter_commands import Command
from greenough.instrument.lightcrafter_packets import Packet
from greenough.instrument.rigfile import load_rig_file
from greenough.pipeline import acquisition
from greenough.pipeline.calibration import Calibration
from greenough.pipeline.unfinished import Unfinished
from greenough.twin.wire.emulated_rig import EmulatedRig
from greenough.twin.wire.gige_camera import Trigger
from greenough.twin.wire.gige_registers import HEARTBEAT_MS
from greenough.twin.wire.lightcrafter import Fault, Faults
from greenough.twin.wire.line_server import LineServer
from interrupts import interrupts_heard

TIMEOUTS_S = {
    "lightcrafter.timeout_s": 2.0,
    "lightcrafter.busy_s": 1.0,
    "zaber.reply_timeout_s": 1.0,
    "zaber.settle_timeout_s": 1.0,
    "genicam.frame_timeout_s": 2.0,
    "operator.wait_s": 2.0,
}
"""As short as a busy machine allows. "30 s silence" is a device that says nothing for as long as anybody waits."""

ERROR_LIMIT_UM = 9.0
"""Of a height by a calibration without fault: the noise of the 94 000 pixels' own fits, of standard deviation 1.3
to 1.5 µm, reaches 5.5 to 7.5 µm somewhere, and 9 µm once in 100 000 calibrations. One wrong frame of a fine set in a
plane's sequence makes 15 µm and more, or leaves pixels uncalibrated."""

DEVIATION_LIMIT = 7.0
"""Standard deviations of a pixel that is right: 500 000 are looked at in a calibration, and one in 4e11 is beyond."""

HEARTBEAT_S = 5.0
"""How long the camera keeps a client that went without a word; without this setting it is 15 s."""

_RUN = "faulty"
_POSTURES, _PLANES = 6, 8
_STEPS_IN_ALL = _POSTURES + 1 + _PLANES
_MOST_FOR_AUTO_EXPOSURE = 12
_FELT_BY = {"projector": ("request", "upload"), "stage": ("message", "move"), "operator": ("place",)}  # others at once
_PATIENT_S = 120.0
_POLL_S = 0.02


@dataclass(frozen=True)
class Call:
    """What one call of `calibrate` came to.

    Parameters
    ----------
    error : exception, optional
        What was raised.
    calibration : Calibration, optional
    struck : bool
        Whether every fault that was ordered has struck.
    after_s : float
        From the first time that the faulty device was spoken to since to the error, or to the end.
    closing_s : float
        From there until the rig had been left.
    safe_when_told : bool
        Whether the projector was dark and the stage at rest when the error came, or the end.
    lit, moves : bool
        Whether the projector was lit and the stage moving when the rig had been left.
    lit_after_connecting : bool
        Whether the projector was lit when the next device was connected to.
    done : int
        Steps that were reported as done, in this call or before.
    kept : tuple of str
        Steps on disk.
    exposures : int
        Triggers that the camera took.
    worst_deviation : float
        Of the grey values that were handed out, from what they should be, in standard deviations.
    children : int
        Processes that were left.
    """

    error: BaseException | None
    calibration: Calibration | None
    struck: bool
    after_s: float
    closing_s: float
    safe_when_told: bool
    lit: bool
    moves: bool
    lit_after_connecting: bool
    done: int
    kept: tuple[str, ...]
    exposures: int
    worst_deviation: float
    children: int

    def is_typed(self, device: str) -> bool:
        """Whether the error is of this device and names it, the command and the remedy."""
        error = self.error
        if not isinstance(error, DeviceError):
            return False
        parts = (error.device, error.command, error.remedy)
        return all(parts) and all(part in str(error) for part in parts) and device in error.device


@dataclass
class _Blow:
    """A fault that is to strike, or has struck."""

    device: str
    struck: bool = False
    felt_s: float | None = None


@dataclass(frozen=True)
class Ended:
    """How a process ended: its exit code, what it said, and how long the camera's process and control outlived it."""

    code: int
    said: str
    camera_process_s: float
    camera_held_s: float


class Bench:
    """Emulated devices and the calibration ``OUT`` that is made with them, in one call or several.

    Parameters
    ----------
    folder : Path
        For the calibration; empty.
    seed : int
        Of the scene's noise.
    """

    def __init__(self, folder: Path, seed: int = 1):
        self.out = folder / "cal.h5"
        self.events: Counter[str] = Counter()
        """What has passed: requests and uploads of the projector, messages and moves of the stage, triggers of the
        camera, placements, and any of them."""
        self.scene = PlainScene(seed, self._placed)
        self.projector_faults: Faults = _no_fault
        self.release_operator = threading.Event()
        """Set to let a placement go on that a fault keeps waiting."""
        self._settings = [
            *SETTINGS,
            *(f"{name}={value}" for name, value in TIMEOUTS_S.items()),
            f'genicam.address="{free_address()}"',
        ]
        self._due: dict[tuple[str, int], Callable[[], None]] = {}
        self._blow = _Blow("")
        self._lock = threading.Lock()
        self._lit_after_connecting, self._first_message = False, 0

    def __enter__(self) -> Self:
        self.rig = EmulatedRig(
            load_rig_file("wire", self._settings), self.scene, free_ports=True, instant_stage=False, homed=True
        )
        self.rig.camera._registers.set_u32(HEARTBEAT_MS, round(1000 * HEARTBEAT_S))
        self.rig.projector_server.faults = self._requested
        self._answer_line, self.rig.stage.answer = self.rig.stage.answer, self._told
        self._picture, self.rig.camera._picture = self.rig.camera._picture, self._triggered
        self.rig.__enter__()
        self.overrides = [*self._settings, *self.rig.overrides]
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.release_operator.set()
        self.rig.stage_server.close()  # which may be another than the rig's own
        self.rig.__exit__(kind, error, traceback)

    @property
    def kept(self) -> tuple[str, ...]:
        """Names of the steps on disk."""
        return tuple(sorted(path.stem for path in Unfinished.beside(self.out).folder.glob("*.h5")))

    def at(self, event: str, number: int, device: str, strike: Callable[[], None]) -> None:
        """Have ``device`` struck at event ``number``, from 1, counted from now."""
        self._blow = _Blow(device)
        self._due[event, self.events[event] + number] = strike

    def reopen_stage_port(self) -> None:
        """Plug in again what was pulled out."""
        server = self.rig.stage_server
        self.rig.stage_server = LineServer(self.rig.stage, server.host, server.tcp_port)

    def wait_for_camera(self) -> None:
        """Until it has no client any more: one that went without a word is taken for gone when its heartbeat ends."""
        wait_until(lambda: not self.rig.camera.is_controlled)

    def wait_for_stage(self) -> float:
        """Until it is at rest; how long that took."""
        return wait_until(lambda: not self.rig.stage.moves)

    def call(self, home_first: bool = False) -> Call:
        """Calibrate as `greenough calibrate` does, and go on with what is on disk."""
        exposures, self._lit_after_connecting = self.rig.camera.triggers, False
        self._first_message = self.events["message"] + 1
        error, calibration, ended_s, worst = None, None, None, [0.0]
        safe_when_told, steps, kept = True, [], self.kept
        try:
            with (
                interrupts_heard(),
                open_rig("wire", self.overrides, _RUN, Unfinished.beside(self.out).exposures) as rig,
                mock.patch.object(acquisition, "estimate_point_spread", _no_point_spread),
            ):
                try:
                    if home_first:
                        rig.stage.home()
                    self._check_frames(rig, worst)
                    calibration = acquisition.calibrate(rig, self.out, _RUN, steps.append, "paper")
                finally:
                    ended_s = time.monotonic()
                    safe_when_told = not (self.rig.projector.lit or self.rig.stage.moves)
        except (Exception, KeyboardInterrupt) as raised:
            error = raised
        closed_s = time.monotonic()
        ended_s = ended_s or closed_s
        struck = self._blow.struck and not self._due
        felt_s, self._blow = self._blow.felt_s, _Blow("")
        self._due.clear()
        return Call(
            error=error,
            calibration=calibration,
            struck=struck,
            after_s=ended_s - (felt_s or ended_s),
            closing_s=closed_s - ended_s,
            safe_when_told=safe_when_told,
            lit=self.rig.projector.lit,
            moves=self.rig.stage.moves,
            lit_after_connecting=self._lit_after_connecting,
            done=max(len(steps), len(kept)),
            kept=self.kept,
            exposures=self.rig.camera.triggers - exposures,
            worst_deviation=worst[0],
            children=len(multiprocessing.active_children()),
        )

    def call_process(self, number: int, sent: signal.Signals, whole_group: bool) -> Ended:
        """`greenough calibrate` in a process of its own, which gets a signal at event ``number`` of any kind.

        With ``whole_group`` its camera's process gets the signal, too, as from a terminal or a service manager.
        """
        command = [Path(sys.executable).with_name("greenough"), "calibrate", "wire", "--out", self.out, "--run", _RUN]
        command += ["--method", "paper", *(part for setting in self.overrides for part in ("--set", setting))]
        children: list[int] = []

        def strike() -> None:
            children.extend(_children(process.pid))
            (os.killpg if whole_group else os.kill)(process.pid, sent)

        with (
            interrupts_heard(),
            subprocess.Popen(
                command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, start_new_session=True
            ) as process,
        ):
            self.at("any", number, "process", strike)
            try:
                _, said = process.communicate(timeout=_PATIENT_S)
            except subprocess.TimeoutExpired:
                os.killpg(process.pid, signal.SIGKILL)
                raise
        began = time.monotonic()
        outlived_s = wait_until(lambda: not any(map(_is_alive, children)))
        held_s = wait_until(lambda: not self.rig.camera.is_controlled) + outlived_s
        assert time.monotonic() - began < _PATIENT_S, "the camera's process did not end, or the camera stayed taken"
        return Ended(process.returncode, said, outlived_s, held_s)

    def _check_frames(self, rig: Rig, worst: list[float]) -> None:
        """Have all frames that the rig hands out compared with what they should be."""
        capture = rig.capture

        def checked(patterns: np.ndarray):
            frames = capture(patterns)
            worst[0] = max(worst[0], self.scene.worst_deviation(frames, patterns))
            return frames

        rig.capture = checked

    def _happened(self, event: str) -> None:
        strikes: list[Callable[[], None] | None] = []
        with self._lock:
            for name in (event, "any"):
                self.events[name] += 1
                strikes.append(self._due.pop((name, self.events[name]), None))
        blow, striking = self._blow, [strike for strike in strikes if strike is not None]
        blow.struck = blow.struck or bool(striking)
        if blow.struck and blow.felt_s is None and (blow.device not in _FELT_BY or event in _FELT_BY[blow.device]):
            blow.felt_s = time.monotonic()
        for strike in striking:
            strike()

    def _requested(self, request: Packet) -> Fault:
        self._happened("request")
        if request.command == Command.PATTERN:
            self._happened("upload")
        return self.projector_faults(request)

    def _told(self, line: bytes) -> list[bytes]:
        if self.events["message"] + 1 == self._first_message:
            self._lit_after_connecting = self.rig.projector.lit
        self._happened("message")
        if b" move abs " in line:
            self._happened("move")
        return self._answer_line(line)

    def _triggered(self, trigger: Trigger) -> np.ndarray:
        self._happened("trigger")
        return self._picture(trigger)

    def _placed(self, placement: Placement) -> None:
        self._happened("place")


@dataclass(frozen=True)
class Outcome:
    """What became of a calibration with a fault, and of the call that followed when it had been mended.

    Parameters
    ----------
    first : Call
    second : Call, optional
        None where the first one has come to its end.
    left : tuple of str
        Threads, sockets and terminals that were left when all had been closed.
    """

    first: Call
    second: Call | None
    left: tuple[str, ...] = ()

    @property
    def error_um(self) -> float:
        """Of the calibration that was made in the end; infinite where there is none."""
        calibration = (self.second or self.first).calibration
        return np.inf if calibration is None else largest_error_um(calibration)


def missing_exposures(kept: tuple[str, ...]) -> tuple[int, int]:
    """The least and the most exposures that a calibration still takes which has kept these steps."""
    least = (_STEPS_IN_ALL - len(kept)) * sum(STEPS)
    exposed_anew = sum(step not in kept for step in ("posture-00", f"plane-{acquisition.ZERO}"))
    return least, least + exposed_anew * _MOST_FOR_AUTO_EXPOSURE


def wait_until(holds: Callable[[], bool]) -> float:
    """How long it took until ``holds``: 0 where it does, and at most a minute."""
    if holds():
        return 0.0
    began = time.monotonic()
    while not holds() and time.monotonic() - began < _PATIENT_S / 2:
        time.sleep(_POLL_S)
    return time.monotonic() - began


def resources() -> tuple[set[str], set[str]]:
    """Threads of this process, and its sockets and terminals."""
    files = set()
    for number in os.listdir("/proc/self/fd"):
        try:
            name = os.readlink(f"/proc/self/fd/{number}")
        except FileNotFoundError:  # the listing's own
            continue
        if name.startswith(("socket:", "/dev/pt")):
            files.add(name)
    return {f"{thread.name} {thread.ident}" for thread in threading.enumerate()}, files


def left_since(before: tuple[set[str], set[str]]) -> tuple[str, ...]:
    """Resources of now that were not there before."""
    return tuple(sorted(name for now, then in zip(resources(), before, strict=True) for name in now - then))


def _children(parent: int) -> list[int]:
    tasks = Path(f"/proc/{parent}/task")
    return [int(pid) for task in tasks.iterdir() for pid in (task / "children").read_text().split()]


def _is_alive(pid: int) -> bool:
    """Whether a process runs, which one that nobody has waited for does not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


def _no_fault(request: Packet) -> Fault:
    return Fault.NONE


def _no_point_spread(*data: object) -> None:
    """It is nothing that devices could spoil, and takes a third of the time."""
    raise InputError("left out")
