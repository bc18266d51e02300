r"""Zaber's ASCII protocol, byte by byte: commands out, replies, infos and alerts in.

A command is ``/device axis id text:CC\n``, its reply ``@device axis id OK|RJ IDLE|BUSY flag data:CC\r\n``. CC are two
hexadecimal digits of the checksum over everything between the first character and the colon. A device also sends infos
(``#device axis id text``) and, unasked, alerts (``!device axis IDLE|BUSY flag text``). A reply that ends in a backslash
goes on in infos whose text begins with ``cont``.
"""

import re
from dataclasses import dataclass

MAX_LINE = 256  # bytes; firmware sends packets of 80
NO_FLAG = "--"

_END_OF_LINE = re.compile(rb"[\r\n]")
_CHECKSUM = re.compile(rb":([0-9A-Fa-f]{2})$")
_REPLY = re.compile(r"@(\d\d) (\d{1,2}) (?:(\d\d) )?(OK|RJ) (IDLE|BUSY) (--|[A-Z]{2})(?: (.*))?")
_ALERT = re.compile(r"!(\d\d) (\d{1,2}) (IDLE|BUSY) (--|[A-Z]{2})(?: (.*))?")
_INFO = re.compile(r"#(\d\d) (\d{1,2}) (?:(\d\d)(?: |$))?(.*)")
_CONTINUES = re.compile(r"cont(?: |$)")


class MalformedMessage(ValueError):
    """A line is no message of this protocol; the text says what it has instead, as in "has ..."."""


@dataclass(frozen=True)
class Message:
    """One line from a device.

    Parameters
    ----------
    kind : str
        ``"@"`` reply, ``"#"`` info, ``"!"`` alert.
    device, axis : int
        Who sent it; axis 0 is the device as a whole.
    message_id : int or None
        That of the command it answers.
    accepted : bool
        False where a reply says RJ; ``data`` is then the reason.
    busy : bool
        Whether the axis, or any axis of the device, moves.
    flag : str
        The warning flag of the highest priority, ``"--"`` if there is none.
    data : str
    more : bool
        Whether infos go on with it.
    continues : bool
        Whether this is an info that goes on with something.
    checked : bool
        Whether it bore a checksum.
    """

    kind: str
    device: int
    axis: int
    message_id: int | None = None
    accepted: bool = True
    busy: bool = False
    flag: str = NO_FLAG
    data: str = ""
    more: bool = False
    continues: bool = False
    checked: bool = False


@dataclass(frozen=True)
class WarningFlag:
    """What a warning flag means, and what a person does about it; a fault has stopped the axis."""

    code: str
    meaning: str
    remedy: str

    @property
    def is_fault(self) -> bool:
        return self.code.startswith("F")


_HOME = "clear the way of the table and home the stage"
_SUPPORT = "switch the stage off and on, home it, and ask the maker if it comes back"
_POWER = "check the power supply, then home the stage"
_ENCODER = "check the encoder's cable, then home the stage"
_WAIT = "wait until it is over, then move again"
_HANDS = "keep hands and other programs off the stage, then move again"
_NOTHING = "go on"

# In the order of the vendor's list, which is nearly that of priority.
FLAGS = {
    flag.code: flag
    for flag in (
        WarningFlag("FF", "critical system error", _SUPPORT),
        WarningFlag("FN", "the connected peripheral is not supported", "connect the stage that fits the controller"),
        WarningFlag("FZ", "the peripheral is inactive", "connect the stage and activate it"),
        WarningFlag("FH", "hardware emergency stop", "release the emergency stop, then home the stage"),
        WarningFlag("FV", "supply voltage out of range, driver disabled", _POWER),
        WarningFlag("FO", "driver disabled on start-up or by command", "home the stage, which enables the driver"),
        WarningFlag("FC", "inrush of current", _POWER),
        WarningFlag("FM", "motor too hot", "let the motor cool down, then home the stage"),
        WarningFlag("FD", "driver disabled by overheating or overcurrent", "let it cool down, then home the stage"),
        WarningFlag("FQ", "encoder error", _ENCODER),
        WarningFlag("FI", "index error of the encoder", _ENCODER),
        WarningFlag("FA", "analogue encoder out of step", _ENCODER),
        WarningFlag("FR", "overdrive limit exceeded", _HOME),
        WarningFlag("FS", "stalled and stopped", _HOME),
        WarningFlag("FB", "stream out of bounds", "move without streams"),
        WarningFlag("FP", "too far off an interpolated path", _HOME),
        WarningFlag("FE", "a limit sensor stopped it or cannot be found", _HOME),
        WarningFlag("FT", "lockstep axes twisted against each other", _SUPPORT),
        WarningFlag("WL", "a limit sensor was met unexpectedly", _HOME),
        WarningFlag("WV", "supply voltage out of range", _POWER),
        WarningFlag("WT", "controller hot", "let the controller cool down"),
        WarningFlag("WS", "stalled and recovered", "clear the way of the table"),
        WarningFlag("WM", "displaced when it stood still", "keep the table free of forces"),
        WarningFlag("WP", "calibration of another type of stage", "set up the controller for this stage"),
        WarningFlag("WR", "no reference position", _HOME),
        WarningFlag("WH", "not homed", _HOME),
        WarningFlag("NC", "moved by its manual control", _HANDS),
        WarningFlag("NI", "movement interrupted", _HANDS),
        WarningFlag("ND", "discontinuity in a stream", _NOTHING),
        WarningFlag("NR", "a value was rounded", _NOTHING),
        WarningFlag("NT", "a value was truncated", _NOTHING),
        WarningFlag("NU", "an update of a setting is pending", _WAIT),
        WarningFlag("NJ", "the joystick is calibrating", _WAIT),
        WarningFlag("NB", "in firmware-update mode", "switch the controller off and on"),
    )
}

# What is known of reasons for refusing a command; firmware may have more.
REJECTIONS = {
    "AGAIN": "it cannot be done right now",
    "BADAXIS": "there is no such axis",
    "BADCOMMAND": "unknown command or setting",
    "BADDATA": "a value is out of range or malformed",
    "BADMESSAGEID": "the message id is not from 0 to 99",
    "DEVICEONLY": "only a device as a whole understands it",
    "DRIVERDISABLED": "the driver is disabled",
    "FULL": "no room is left",
    "INACTIVE": "the axis is inactive",
    "LOCKSTEP": "the axis is locked to another one",
    "NOTSUPPORTED": "this product cannot do it",
    "PARKED": "the axis is parked",
    "STATUSBUSY": "the axis is moving",
}


def checksum(content: bytes) -> int:
    """Longitudinal redundancy check of what lies between the first character and the colon: minus its sum, mod 256."""
    return -sum(content) & 0xFF


def encode_command(text: str, device: int, axis: int, message_id: int) -> bytes:
    """The line that tells ``axis`` of ``device`` to do ``text``; an empty text asks for the status alone."""
    content = f"{device} {axis} {message_id:02d}{' ' if text else ''}{text}".encode("ascii")
    return b"/%s:%02X\n" % (content, checksum(content))


def parse_message(line: bytes) -> Message:
    """Read one line without its end.

    Raises
    ------
    MalformedMessage
        When the line is too long, not printable ASCII, bears a wrong checksum or has no such format.
    """
    if len(line) > MAX_LINE:
        raise MalformedMessage(f"more than {MAX_LINE} bytes")
    if not line.isascii() or not (text := line.decode("ascii")).isprintable():
        raise MalformedMessage("bytes that are not printable ASCII")
    borne = _CHECKSUM.search(line)
    if borne:
        computed = checksum(line[1 : borne.start()])
        if int(borne[1], 16) != computed:
            raise MalformedMessage(f"the checksum {text[-2:]} instead of {computed:02X}")
        text = text[: borne.start()]
    more = text.endswith("\\")
    if more:
        text = text[:-1].rstrip(" ")
    if reply := _REPLY.fullmatch(text):
        device, axis, message_id, result, status, flag, data = reply.groups()
    elif alert := _ALERT.fullmatch(text):
        device, axis, status, flag, data = alert.groups()
        message_id, result = None, "OK"
    elif info := _INFO.fullmatch(text):
        device, axis, message_id, data = info.groups()
        result, status, flag = "OK", "IDLE", NO_FLAG
    else:
        raise MalformedMessage("not the format of a message")
    data = data or ""
    continues = text[0] == "#" and bool(_CONTINUES.match(data))
    return Message(
        kind=text[0],
        device=int(device),
        axis=int(axis),
        message_id=None if message_id is None else int(message_id),
        accepted=result == "OK",
        busy=status == "BUSY",
        flag=flag,
        data=data[len("cont") :].strip(" ") if continues else data,
        more=more,
        continues=continues,
        checked=borne is not None,
    )


def parse_flags(data: str) -> tuple[str, ...]:
    """The flags that the reply to ``warnings`` lists, as in ``"02 FS WR"``.

    Raises
    ------
    MalformedMessage
        When it is no such list.
    """
    if not re.fullmatch(r"\d\d( [A-Z]{2})*", data):
        raise MalformedMessage("no list of warning flags")
    count, *flags = data.split(" ")
    if int(count) != len(flags):
        raise MalformedMessage(f"{len(flags)} warning flags instead of {count}")
    return tuple(flags)


def describe_flag(code: str) -> WarningFlag:
    """What a flag means; of one that came with later firmware, where to look it up."""
    return FLAGS.get(code) or WarningFlag(code, "a flag of newer firmware", "look it up in the protocol's manual")


class LineBuffer:
    """Cuts what comes over a wire into lines, in bounded memory."""

    def __init__(self) -> None:
        self._pending = bytearray()

    def feed(self, received: bytes) -> list[bytes]:
        """The lines that ``received`` completes, without their ends.

        Carriage returns and line feeds end lines; empty lines are left out. Of a line longer than ``MAX_LINE`` one byte
        more than that is kept, so that it is refused where it is read.
        """
        *ends, rest = _END_OF_LINE.split(received)
        lines = []
        for end in ends:
            self._append(end)
            if self._pending:
                lines.append(bytes(self._pending))
                self._pending.clear()
        self._append(rest)
        return lines

    def clear(self) -> None:
        """Forget the beginning of a line."""
        self._pending.clear()

    def _append(self, part: bytes) -> None:
        self._pending += part[: MAX_LINE + 1 - len(self._pending)]
