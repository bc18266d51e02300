"""A z stage of Zaber's, or of whoever speaks its ASCII protocol, behind the contract.

The device counts microsteps from its home position; the rig file says where the contract's 0 mm lies, how long a
microstep is and which way is up. A position is given out only while the device vouches for it: homed, and no fault.
"""

import contextlib
import logging
import math
import re
import time
from dataclasses import dataclass
from types import TracebackType
from typing import Annotated, Literal, Self

from pydantic import BaseModel, ConfigDict, Field

from .device_errors import BadReply, DeviceError, Fault, Rejected, TimedOut
from .limits import check_within
from .zaber_link import ZaberLink
from .zaber_messages import NO_FLAG, MalformedMessage, Message, describe_flag, parse_flags

_log = logging.getLogger(__name__)
_UNIT = 1.6384  # the firmware's speeds are in 1/1.6384 microsteps/s, accelerations in 10000/1.6384 microsteps/s²
_POLL_S = 0.02
_ARRIVED_UM = 10.0  # an encoder's last counts are noise; anything farther off is not where it was sent
_PLACELESS = ("WR", "WH", "WL")  # with these the count of microsteps says nothing, or less than it should
_INTERRUPTED = ("NI", "NC")
_DRIVER_OFF = ("FH", "FO", "FD", "FV")
_FREE = "clear the way of the table, home the stage and try again"
_ASK_AGAIN = "check the cable and try again"


class ZaberSettings(BaseModel):
    """``[zaber]`` of a rig file: how the stage is reached and what its microsteps mean.

    Parameters
    ----------
    port : str
        ``/dev/ttyUSB0``, better ``/dev/serial/by-id/...``, or ``socket://host:port``.
    device, axis : int
        Numbers in the chain, from 1.
    baud : int
    microstep_um : float
        Length of a microstep, from the product's data sheet at its present resolution.
    zero_microsteps : int
        The device's count at the contract's 0 mm.
    direction : 1 or -1
        1 where more microsteps are further up, towards the microscope.
    reply_timeout_s : float
        How long to wait for an answer.
    settle_timeout_s : float
        How long a motion may take beyond twice the time that distance, speed and acceleration ask for.
    home_timeout_s : float
        How long homing may take.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)
    port: Annotated[str, Field(min_length=1, max_length=200, examples=["/dev/ttyUSB0"])]
    device: Annotated[int, Field(ge=1, le=99)] = 1
    axis: Annotated[int, Field(ge=1, le=9)] = 1
    baud: Annotated[int, Field(ge=9600, le=921_600)] = 115_200
    microstep_um: Annotated[float, Field(gt=0, le=100)]
    zero_microsteps: Annotated[int, Field(ge=-(2**31), le=2**31)]
    direction: Literal[1, -1] = 1
    reply_timeout_s: Annotated[float, Field(ge=0.05, le=60)] = 1.0
    settle_timeout_s: Annotated[float, Field(ge=0.05, le=600)] = 3.0
    home_timeout_s: Annotated[float, Field(ge=0.05, le=3600)] = 60.0


@dataclass(frozen=True)
class StageIdentity:
    """What the controller says of itself."""

    device_id: str
    serial: str
    firmware: str


class ZaberStage:
    """The stage: a context manager that connects, and on the way out stops and disconnects. It never moves unasked.

    Whatever speaks with the device may raise TimedOut, Rejected, Fault, BadReply and ConnectionLost.
    A motion that ends in an error is stopped first, which takes up to two more reply time-outs.

    Parameters
    ----------
    settings : ZaberSettings
    limits_mm : (float, float)
        The rig file's limits; once connected, the device's own apply as well.
    """

    def __init__(self, settings: ZaberSettings, limits_mm: tuple[float, float]):
        self.settings = settings
        self.limits_mm = limits_mm
        self.identity: StageIdentity | None = None
        self._opened: ZaberLink | None = None
        self._speed = self._acceleration = 0.0  # microsteps/s, microsteps/s²
        self._mentioned: set[str] = set()  # flags in the log

    def connect(self) -> None:
        """Open the port and ask what the device is and may do. Moves nothing; what is moving is stopped."""
        settings = self.settings
        link = ZaberLink(settings.port, settings.device, settings.baud, settings.reply_timeout_s)
        self._opened = link
        try:
            link.checked = self._answers_are_checked(link)
            self.identity = StageIdentity(self._device_id(), self._get("system.serial", 0), self._get("version", 0))
            self._speed = self._number("maxspeed") / _UNIT
            self._acceleration = self._number("accel") * 10_000 / _UNIT
            if self._ask("").busy:
                _log.warning("%s was moving and is stopped", link.name)
                self.stop()
            self.limits_mm = self._joint_limits()
        except BaseException:
            self.disconnect()
            raise

    def disconnect(self) -> None:
        """Close the port; may be called again."""
        if self._opened is not None:
            self._opened.close()
            self._opened = None

    @property
    def position_mm(self) -> float:
        """The device's own reading. Raises Fault where the device does not vouch for it: at fault, or not homed."""
        return self._mm(self._count("get pos", _PLACELESS))

    @property
    def homed(self) -> bool:
        """Whether the device knows where the table is."""
        return not set(self.warnings()) & set(_PLACELESS)

    def warnings(self) -> tuple[str, ...]:
        """All flags that the axis raises now; ``zaber_messages.describe_flag`` says what they mean."""
        data = self._ask("warnings").data
        try:
            return parse_flags(data)
        except MalformedMessage as fault:
            raise BadReply(self._link.name, "warnings", data.encode(), str(fault), _ASK_AGAIN) from None

    def move_to_mm(self, position: float) -> None:
        """Move and wait.

        Raises
        ------
        InputError
            Outside ``limits_mm``, before anything is sent.
        DeviceError
            When the stage is not homed, at fault, interrupted, or not there in twice the time that it should take and
            ``settle_timeout_s``.
        """
        check_within(position, self.limits_mm, "stage position", "mm")
        settings = self.settings
        target = settings.zero_microsteps + settings.direction * round(position * 1e3 / settings.microstep_um)
        command = f"move abs {target}"
        way = abs(target - self._count(command, _PLACELESS))
        reached = self._move(command, 2 * travel_s(way, self._speed, self._acceleration) + settings.settle_timeout_s)
        if abs(reached - target) * settings.microstep_um > _ARRIVED_UM:
            raise DeviceError(self._link.name, command, f"it stands at {reached} instead", _FREE)

    def home(self) -> None:
        """Find the reference position, after taking back faults that are over, and wait.

        Raises
        ------
        DeviceError
            When a fault persists, or homing takes longer than ``home_timeout_s``.
        """
        self._ask("warnings clear")
        if set(self.warnings()) & set(_DRIVER_OFF):
            with contextlib.suppress(Rejected):  # what keeps it off is reported as the fault that it is
                self._ask("driver enable")
        self._vouch(self._ask(""), "home", ())
        self._move("home", self.settings.home_timeout_s)

    def stop(self) -> None:
        """Come to rest and wait for it."""
        self._ask("stop")
        brake_s = self._speed / self._acceleration if self._acceleration else 0.0
        self._wait_until_idle("stop", 2 * brake_s + self.settings.settle_timeout_s, faults=False)

    def __enter__(self) -> Self:
        self.connect()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None, /
    ) -> None:
        try:
            if kind is None:
                self.stop()
            else:
                self._stop_if_possible()
        finally:
            self.disconnect()

    def _move(self, command: str, timeout_s: float) -> int:
        """Do ``command``, wait, and return where it ended."""
        try:
            try:
                self._ask(command)
            except Rejected:
                self._vouch(self._ask(""), command, ())  # a fault says better why
                raise
            self._wait_until_idle(command, timeout_s)
            return self._count(command, (*_PLACELESS, *_INTERRUPTED))
        except BaseException:
            self._stop_if_possible()
            raise

    def _stop_if_possible(self) -> None:
        """Stop on the way out of an error, which is the one to report."""
        for _ in range(2):  # one line may be damaged
            try:
                self.stop()
            except (BadReply, TimedOut) as error:
                _log.warning("%s", error)
            except DeviceError as error:
                _log.warning("%s", error)
                return
            else:
                return

    def _wait_until_idle(self, command: str, timeout_s: float, faults: bool = True) -> None:
        deadline = time.monotonic() + timeout_s
        while True:
            status = self._ask("")
            if faults:
                self._vouch(status, command, ())
            if not status.busy:
                return
            if time.monotonic() > deadline:
                raise TimedOut(self._link.name, command, timeout_s, _FREE, "the end of the motion")
            time.sleep(_POLL_S)

    def _vouch(self, reply: Message, command: str, refused: tuple[str, ...]) -> None:
        """Raise Fault if the axis is at fault or raises a flag of ``refused``; a reply itself shows one flag of all."""
        if reply.flag == NO_FLAG:
            return
        for code in dict.fromkeys((reply.flag, *self.warnings())):
            flag = describe_flag(code)
            if flag.is_fault or code in refused:
                raise Fault(self._link.name, command, code, flag.meaning, flag.remedy)
            if code not in (*_PLACELESS, *self._mentioned):
                self._mentioned.add(code)
                _log.warning("%s reports %s (%s); %s", self._link.name, code, flag.meaning, flag.remedy)

    def _count(self, command: str, refused: tuple[str, ...]) -> int:
        """Where the axis is, in microsteps, if the device vouches for it; ``command`` is what it is asked for."""
        reply = self._ask("get pos")
        self._vouch(reply, command, refused)
        return self._whole("get pos", reply.data)

    def _joint_limits(self) -> tuple[float, float]:
        ends = sorted(self._mm(self._number(name)) for name in ("limit.min", "limit.max"))
        low, high = max(ends[0], self.limits_mm[0]), min(ends[1], self.limits_mm[1])
        if low >= high:
            what = "its range of {:g} to {:g} mm has nothing in common with the rig file's {:g} to {:g} mm"
            what = what.format(*ends, *self.limits_mm)
            remedy = "correct zero_microsteps, microstep_um and direction in the rig file"
            raise DeviceError(self._link.name, "get limit.max", what, remedy)
        return low, high

    def _answers_are_checked(self, link: ZaberLink) -> bool:
        """Whether answers bear checksums, which older firmware must be told."""
        if not link.ask("", 0).checked:
            with contextlib.suppress(Rejected):
                link.ask("set comm.checksum 1", 0)
        checked = link.ask("", 0).checked
        if not checked:
            _log.warning("%s answers without checksums: damaged answers may pass", link.name)
        return checked

    def _device_id(self) -> str:
        try:
            return self._get("device.id", 0)
        except Rejected:  # older firmware
            return self._get("deviceid", 0)

    def _get(self, name: str, axis: int) -> str:
        return self._ask(f"get {name}", axis).data

    def _number(self, name: str) -> int:
        return self._whole(f"get {name}", self._get(name, self.settings.axis))

    def _whole(self, command: str, data: str) -> int:
        if not re.fullmatch(r"-?\d{1,12}", data):
            raise BadReply(self._link.name, command, data.encode(), "no whole number", _ASK_AGAIN)
        return int(data)

    def _mm(self, count: int) -> float:
        settings = self.settings
        return settings.direction * (count - settings.zero_microsteps) * settings.microstep_um * 1e-3

    def _ask(self, text: str, axis: int | None = None) -> Message:
        return self._link.ask(text, self.settings.axis if axis is None else axis)

    @property
    def _link(self) -> ZaberLink:
        if self._opened is None:
            raise RuntimeError("the stage is not connected: use it as a context manager")
        return self._opened


def travel_s(way: float, speed: float, acceleration: float) -> float:
    """Time from rest to rest, over ``way`` >= 0 in any unit of length, with ramps of ``acceleration``; 0 is none."""
    if acceleration == 0:
        return way / speed
    if way * acceleration < speed**2:  # it never gets up to speed
        return 2 * math.sqrt(way / acceleration)
    return way / speed + speed / acceleration
