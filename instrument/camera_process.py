"""A camera in a process of its own: whatever its library does to the process it runs in, this one goes on.

Aravis, for one, ends its process on some damaged packets. Here that is an error like any other.
"""

import contextlib
import multiprocessing
import signal
import time
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection
from types import FrameType, TracebackType
from typing import Any, NoReturn, Self

from .contract import CameraNoise
from .device_errors import ConnectionLost, TimedOut
from .limits import check_within
from .triggered_camera import CameraIdentity, Shot, TriggeredCamera

_START_TIMEOUT_S = 120.0  # a process may have to wait long for its turn
_COMMAND_TIMEOUT_S = 60.0  # longer than the camera's own, which speak first
_REMEDY = "see to its power and its cable, and run again"


@dataclass(frozen=True)
class _Fixed:
    """What an open camera does not change any more."""

    identity: CameraIdentity
    shape: tuple[int, int]
    full_scale_dn: float
    black_level_dn: float
    noise: CameraNoise
    exposure_limits_us: tuple[float, float]
    gain_db: float


class CameraProcess:
    """A camera that is opened elsewhere; it satisfies ``TriggeredCamera`` and is a context manager.

    Parameters
    ----------
    open_camera : function
        Opens it, in the other process: ``functools.partial(GenicamCamera, section, settings)``. It must be picklable.
    name : str
        For errors: ``"camera at 192.168.0.10"``.
    frame_timeout_s : float
        How long a frame may take beyond its exposure time, by the camera's own settings.

    Raises
    ------
    InputError
        Whatever ``open_camera`` raises.
    DeviceError
        The same; ConnectionLost also where the process ends, TimedOut where it hangs, a minute after the camera's own.
    """

    def __init__(self, open_camera: Callable[[], TriggeredCamera], name: str, frame_timeout_s: float):
        self._name, self._frame_timeout_s = name, frame_timeout_s
        self._asked = 0  # commands so far: an answer that was not waited for is not taken for the next one's
        self._closed = False
        context = multiprocessing.get_context("spawn")
        self._connection, other = context.Pipe()
        self._process = context.Process(target=_serve, args=(other, open_camera), name=name, daemon=True)
        try:
            with other:
                self._process.start()
            self._fixed, self._exposure_us = self._receive("connect", _START_TIMEOUT_S)
        except BaseException:
            self._end()
            raise

    @property
    def identity(self) -> CameraIdentity:
        return self._fixed.identity

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, cols)."""
        return self._fixed.shape

    @property
    def full_scale_dn(self) -> float:
        return self._fixed.full_scale_dn

    @property
    def black_level_dn(self) -> float:
        return self._fixed.black_level_dn

    @property
    def noise(self) -> CameraNoise:
        return self._fixed.noise

    @property
    def gain_db(self) -> float:
        return self._fixed.gain_db

    @property
    def exposure_limits_us(self) -> tuple[float, float]:
        return self._fixed.exposure_limits_us

    @property
    def exposure_us(self) -> float:
        """As the camera took it."""
        return self._exposure_us

    @exposure_us.setter
    def exposure_us(self, value: float) -> None:
        check_within(value, self.exposure_limits_us, "exposure time", "us")
        self._exposure_us = self._ask("set_exposure", float(value))

    def arm(self) -> None:
        """Make ready for triggers."""
        self._ask("arm")

    def trigger_and_grab(self) -> Shot:
        """Expose one frame from now on and wait for it."""
        return self._ask("trigger_and_grab", timeout_s=self._exposure_us / 1e6 + self._frame_timeout_s)

    def disarm(self) -> None:
        """Take no more frames."""
        self._ask("disarm")

    def close(self) -> None:
        """Close the camera and end its process, also one that hangs or is gone; a second call does nothing."""
        if self._closed:
            return
        self._closed = True
        try:
            self._ask("close")
        except (ConnectionLost, TimedOut):
            pass  # nothing is left to close
        finally:
            self._end()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None, /
    ) -> None:
        self.close()

    def _ask(self, command: str, *arguments: Any, timeout_s: float = 0.0) -> Any:
        if self._connection.closed:
            raise ConnectionLost(self._name, command, "it was closed or interrupted", _REMEDY)
        try:
            self._asked += 1
            self._undivided(self._connection.send, (self._asked, command, arguments))
        except OSError:
            raise self._gone(command) from None
        return self._receive(command, timeout_s + _COMMAND_TIMEOUT_S)

    def _receive(self, command: str, timeout_s: float) -> Any:
        deadline = time.monotonic() + timeout_s
        try:
            while True:
                if not self._connection.poll(max(0.0, deadline - time.monotonic())):
                    self._process.kill()
                    raise TimedOut(self._name, command, timeout_s, _REMEDY)
                answered, done, result = self._undivided(self._connection.recv)
                if answered == self._asked:
                    break
        except (EOFError, OSError):
            raise self._gone(command) from None
        if not done:
            raise result
        return result

    def _undivided(self, pass_on: Callable[..., Any], *message: Any) -> Any:
        """Send or receive. An interrupt hangs up: what is left would be taken for the next message.

        The process lets go of the camera then and ends; killed, it would leave it taken until a heartbeat ends.
        """
        try:
            return pass_on(*message)
        except (EOFError, OSError):
            raise
        except BaseException:
            self._connection.close()
            raise

    def _gone(self, command: str) -> ConnectionLost:
        self._process.join(_COMMAND_TIMEOUT_S)
        return ConnectionLost(self._name, command, f"its process ended with {self._process.exitcode}", _REMEDY)

    def _end(self) -> None:
        self._connection.close()  # an idle process ends by that
        if self._process.pid is None:
            return  # it was interrupted before it knew what to do, and ends by that, too
        self._process.join(_COMMAND_TIMEOUT_S)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()
        self._process.close()


def _serve(connection: Connection, open_camera: Callable[[], TriggeredCamera]) -> None:
    """The other process: commands come, and their results or errors go."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # an interrupt is up to who asks
    signal.signal(signal.SIGTERM, _leave)
    try:
        camera = open_camera()
    except Exception as error:
        with contextlib.suppress(OSError):  # who asked is gone
            connection.send((0, False, error))
        return
    try:
        fixed = _Fixed(**{name: getattr(camera, name) for name in _Fixed.__dataclass_fields__})
        connection.send((0, True, (fixed, camera.exposure_us)))
        while True:
            number, command, arguments = connection.recv()
            try:
                reply = number, True, _do(camera, command, arguments)
            except Exception as error:
                reply = number, False, error
            connection.send(reply)
    except (EOFError, OSError):
        pass  # who asked is gone
    finally:
        camera.close()


def _leave(signal_number: int, frame: FrameType | None) -> NoReturn:
    """End by an exception, so that the camera is let go of; else it would keep its client until a heartbeat ends."""
    raise SystemExit(128 + signal_number)


def _do(camera: TriggeredCamera, command: str, arguments: tuple) -> Any:
    if command == "set_exposure":
        (camera.exposure_us,) = arguments
        return camera.exposure_us
    return getattr(camera, command)(*arguments)
