"""A Zaber stage that is not there: a controller with one axis, behind its ASCII protocol.

Lines come in and lines go out; ``line_server`` puts them on a port. Positions are microsteps; speed and acceleration
are settings in the firmware's units of 1/1.6384 microsteps/s and 10000/1.6384 microsteps/s².
"""

import math
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

from .motion import Motion, braking, trapezoid
from .zaber_lines import Command, encode_line, parse_command, pieces

_UNIT = 1.6384
_PRIORITY = ("FH", "FO", "FS", "WR", "NC", "NI")  # of the flags that this one raises
_LARGEST = 2**31 - 1


@dataclass(frozen=True)
class StageModel:
    """A product, and how it is switched on.

    Parameters
    ----------
    travel : int
        From the home position, which is 0, to the other end.
    start : int
        Where it happens to stand when it is switched on, from the home position.
    maxspeed, accel : int
        In the firmware's units; an acceleration of 0 is infinite.
    instant : bool
        Whether a motion has ended when it has begun.
    mirrors_checksums : bool
        Whether a command with a checksum is answered with one even while ``comm.checksum`` is 0.
    packet : int
        Longest line sent, in characters; what is longer goes on in infos.
    address, device_id, serial : int
    firmware : str
    """

    travel: int = 1_066_667
    start: int = 400_000
    maxspeed: int = 1_048_576
    accel: int = 820
    instant: bool = False
    mirrors_checksums: bool = True
    packet: int = 80
    address: int = 1
    device_id: int = 50_105
    serial: int = 31_415
    firmware: str = "7.38"


class _Refused(Exception):
    """Why a command is rejected, in the firmware's word."""


class ZaberDevice:
    """The controller's state machine, and the faults it can be given; safe to use from several threads.

    Parameters
    ----------
    model : StageModel
    on_position : callable, optional
        Called with the table's true place, in microsteps from the home position, before a host is told of it.
    clock : callable, optional
        Seconds that never go backwards.
    """

    def __init__(
        self,
        model: StageModel | None = None,
        on_position: Callable[[float], None] | None = None,
        clock: Callable[[], float] = time.monotonic,
    ):
        self.model = model or StageModel()
        self.messages = 0  # from hosts, so far
        self._on_position = on_position or (lambda position: None)
        self._clock = clock
        self._lock = threading.RLock()
        self._due: dict[int, list[Callable[[], None]]] = {}
        self._told = float(self.model.start)
        self._silent = self._stalls = self._hangs = self._stopped_by_hand = False
        self._spoil: Callable[[bytes], list[bytes]] | None = None
        self._late: list[bytes] = []
        self._alerts: list[bytes] = []
        self._switch_on(self.model.start)

    @property
    def position(self) -> float:
        """The table's true place, microsteps from the home position."""
        with self._lock:
            return self._motion.at(self._clock())[0]

    @property
    def moves(self) -> bool:
        with self._lock:
            return self._moves()

    def answer(self, line: bytes) -> list[bytes]:
        """What the device sends when it has received ``line``: lines with their ends; none where it keeps silent."""
        with self._lock:
            self._settle()
            command = parse_command(line)
            if command is None or command.device not in (0, self.model.address):
                return self._taken_alerts()
            self.messages += 1
            for fault in self._due.pop(self.messages, ()):
                fault()
            reply = self._reply(command)
            self._settle_instantly()
            late, self._late = self._late, []
            if self._silent:
                reply = []
            elif self._spoil is not None:
                spoil, self._spoil = self._spoil, None
                reply = [spoiled for sent in reply for spoiled in spoil(sent)]
            alerts, position = self._taken_alerts(), self._motion.at(self._clock())[0]
        self._tell(position)
        return [*alerts, *late, *reply]

    def tick(self) -> list[bytes]:
        """What the device sends of itself, now."""
        with self._lock:
            self._settle()
            alerts, position = self._taken_alerts(), self._motion.at(self._clock())[0]
        self._tell(position)
        return alerts

    def reference(self) -> None:
        """Be homed, and where it is: as if it had been homed by somebody before."""
        with self._lock:
            self._referenced()

    # Faults. Each takes effect at once or with the next command.

    def at_message(self, number: int, fault: Callable[[], None]) -> None:
        """Call ``fault`` when message ``number``, counted from 1, has come and before it is obeyed."""
        with self._lock:
            self._due.setdefault(number, []).append(fault)

    def stall(self) -> None:
        """Stop half-way in this motion or the next, with the flag FS."""
        with self._lock:
            self._settle()
            self._stalls = True
            if self._moves():
                self._halt()

    def hang(self) -> None:
        """Never arrive: stay busy from the next motion on until told to stop."""
        with self._lock:
            self._hangs = True

    def press_emergency_stop(self) -> None:
        """Stop at once and cut the driver off, with the flag FH."""
        with self._lock:
            self._stopped_by_hand = True
            self._halt()
            self._flags |= {"FH"}

    def release_emergency_stop(self) -> None:
        """The flag stays until the driver is enabled."""
        with self._lock:
            self._stopped_by_hand = False

    def turn_knob(self, microsteps: int) -> None:
        """Move by hand, with the flags NC and, out of a motion, NI."""
        with self._lock:
            now = self._clock()
            interrupted = {"NI"} if self._moves() else set()
            self._halt()
            self._motion = Motion(now, self._motion.end + microsteps)
            self._flags |= {"NC"} | interrupted

    def switch_off_and_on(self) -> None:
        """Forget the reference and all settings; the table stays where it is."""
        with self._lock:
            self._switch_on(self._motion.at(self._clock())[0])

    def spoil(self, how: Callable[[bytes], list[bytes]]) -> None:
        """Send ``how(line)`` in place of each line of the next reply: see ``line_faults``."""
        with self._lock:
            self._spoil = how

    def delay(self) -> None:
        """Send the next reply only before the one after it."""

        def keep(line: bytes) -> list[bytes]:
            self._late.append(line)
            return []

        self.spoil(keep)

    def fall_silent(self) -> None:
        """Obey and answer nothing, until told to speak."""
        with self._lock:
            self._silent = True

    def speak(self) -> None:
        with self._lock:
            self._silent = False

    # The firmware.

    def _switch_on(self, position: float) -> None:
        model = self.model
        self._settings = {
            "limit.min": 0,
            "limit.max": model.travel,
            "maxspeed": model.maxspeed,
            "accel": model.accel,
            "comm.checksum": 0,
            "comm.alert": 0,
        }
        self._motion = Motion(self._clock(), position)
        self._zero = position  # counts begin at 0 wherever it stands, until it is homed
        self._flags = {"WR"}
        self._at_end: Callable[[], None] | None = None
        self._was_moving = False

    def _reply(self, command: Command) -> list[bytes]:
        try:
            if command.axis > 1:
                raise _Refused("BADAXIS")
            if command.message_id is not None and command.message_id > 99:
                raise _Refused("BADMESSAGEID")
            result, data = "OK", self._obey(command.words)
        except _Refused as refusal:
            result, data = "RJ", str(refusal)
        message_id = None if command.message_id is None else command.message_id % 100
        where = f"{self.model.address:02d} {command.axis}" + ("" if message_id is None else f" {message_id:02d}")
        status = "BUSY" if self._moves() else "IDLE"
        checked = bool(self._settings["comm.checksum"]) or (command.checked and self.model.mirrors_checksums)
        first, *rest = pieces(data, self.model.packet - len(where) - 20)
        contents = [f"@{where} {result} {status} {self._flag()} {first}", *(f"#{where} cont {part}" for part in rest)]
        more = [*(["\\"] * len(rest)), ""]
        return [encode_line(content + mark, checked) for content, mark in zip(contents, more, strict=True)]

    def _obey(self, words: list[str]) -> str:
        match words:
            case []:
                return "0"
            case ["home"]:
                return self._move_to(0.0, self._referenced)
            case ["move", "abs", value]:
                return self._move_to(self._within_limits(_number(value)) + self._zero)
            case ["move", "rel", value]:
                count = self._motion.at(self._clock())[0] - self._zero
                return self._move_to(self._within_limits(round(count) + _number(value)) + self._zero)
            case ["move", "min" | "max" as end]:
                return self._move_to(self._settings[f"limit.{end}"] + self._zero)
            case ["move", "abs" | "rel", *_]:
                raise _Refused("BADDATA")
            case ["stop" | "estop" as how]:
                self._stop(abruptly=how == "estop")
                return "0"
            case ["get", name]:
                return self._get(name)
            case ["set", name, value]:
                return self._set(name, _number(value))
            case ["warnings"]:
                return self._list()
            case ["warnings", "clear"]:
                flags = self._list()
                self._flags -= {"FS", "NC", "NI"}
                return flags
            case ["driver", "disable"]:
                self._halt()
                self._flags |= {"FO"}
                return "0"
            case ["driver", "enable"]:
                if self._stopped_by_hand:
                    raise _Refused("AGAIN")
                self._flags -= {"FH", "FO"}
                return "0"
            case ["system", "reset"]:
                self._switch_on(self._motion.at(self._clock())[0])
                return "0"
            case ["tools", "echo", *echoed]:
                return " ".join(echoed) or "0"
        raise _Refused("BADCOMMAND")

    def _get(self, name: str) -> str:
        model = self.model
        fixed = {
            "device.id": model.device_id,
            "deviceid": model.device_id,
            "system.serial": model.serial,
            "version": model.firmware,
            "system.axiscount": 1,
            "resolution": 64,
            "comm.address": model.address,
            "comm.packet.size.max": model.packet,
        }
        if name == "pos":
            return str(round(self._motion.at(self._clock())[0] - self._zero))
        if name not in self._settings and name not in fixed:
            raise _Refused("BADCOMMAND")
        return str(self._settings.get(name, fixed.get(name)))

    def _set(self, name: str, value: int) -> str:
        if name not in self._settings:
            raise _Refused("BADCOMMAND")
        highest = 1 if name.startswith("comm.") else _LARGEST
        if not (1 if name == "maxspeed" else 0) <= value <= highest:
            raise _Refused("BADDATA")
        self._settings[name] = value
        return "0"

    def _move_to(self, target: float, at_end: Callable[[], None] | None = None) -> str:
        if self._flags & {"FH", "FO"}:
            raise _Refused("DRIVERDISABLED")
        self._flags -= {"NC", "NI"}
        self._interrupt()
        now = self._clock()
        start = self._motion.at(now)[0]
        if self._stalls:
            target, at_end = (start + target) / 2, None
        self._motion = trapezoid(start, target, self._settings["maxspeed"] / _UNIT, self._acceleration(), now)
        if self._hangs:
            self._motion = Motion(math.inf, target, self._motion.phases)
        self._at_end, self._was_moving = at_end, True
        return "0"

    def _referenced(self) -> None:
        self._zero = 0.0
        self._flags -= {"WR"}

    def _stop(self, abruptly: bool) -> None:
        self._interrupt()
        self._hangs = False
        if abruptly:
            self._halt()
            return
        now = self._clock()
        self._motion = braking(*self._motion.at(now), self._acceleration(), now)

    def _halt(self) -> None:
        self._settle()
        now = self._clock()
        self._motion = Motion(now, self._motion.at(now)[0])
        self._at_end = None

    def _interrupt(self) -> None:
        """Whatever was under way will not be completed."""
        if self._moves():
            self._flags |= {"NI"}
        self._at_end = None

    def _settle(self) -> None:
        """Do what the end of a motion brings about, if it has ended; alert hosts to it if they want alerts."""
        if not self._was_moving or self._moves():
            return
        self._was_moving = False
        if self._stalls:
            self._stalls = False
            self._flags |= {"FS"}
        elif self._at_end is not None:
            self._at_end()
        self._at_end = None
        if self._settings["comm.alert"] and not self._silent:
            content = f"!{self.model.address:02d} 1 IDLE {self._flag()}"
            self._alerts = [encode_line(content, bool(self._settings["comm.checksum"]))]

    def _taken_alerts(self) -> list[bytes]:
        alerts, self._alerts = self._alerts, []
        return alerts

    def _settle_instantly(self) -> None:
        if self.model.instant and not self._hangs:
            self._motion = Motion(self._clock(), self._motion.end)

    def _moves(self) -> bool:
        return self._clock() < self._motion.ended_s

    def _acceleration(self) -> float:
        return self._settings["accel"] * 10_000 / _UNIT or math.inf

    def _within_limits(self, count: int) -> int:
        if not self._settings["limit.min"] <= count <= self._settings["limit.max"]:
            raise _Refused("BADDATA")
        return count

    def _raised(self) -> list[str]:
        return [flag for flag in _PRIORITY if flag in self._flags]

    def _flag(self) -> str:
        return (self._raised() or ["--"])[0]

    def _list(self) -> str:
        raised = self._raised()
        return " ".join([f"{len(raised):02d}", *raised])

    def _tell(self, position: float) -> None:
        if position != self._told:
            self._told = position
            self._on_position(position)


def _number(text: str) -> int:
    digits = text.removeprefix("-")
    if not digits.isdecimal() or len(digits) > 10 or int(digits) > _LARGEST:
        raise _Refused("BADDATA")
    return int(text)
