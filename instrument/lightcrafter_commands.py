"""What the commands of a TI DLP LightCrafter carry, and the limits that its maker states for pattern sequences.

Integers go low byte first. Times are in microseconds, as on the wire.
"""

import struct
from dataclasses import dataclass
from enum import IntEnum

PORT = 0x5555
SHAPE = (684, 608)  # rows and columns of its mirrors
BIT_PLANES = 96  # of the memory that patterns are shown from
LOAD_US = 250  # from the end of an exposure until the next pattern is loaded, as TI advises
LONGEST_US = 2**32 - 1  # that fits on the wire
SHORTEST_EXPOSURE_US = {1: 250, 2: 666, 3: 1470, 4: 1600, 5: 2000, 6: 2500, 7: 4500, 8: 8333}  # by bit depth
LONGEST_EXPOSURE_US = {1: 2_000_000, **dict.fromkeys(range(2, 9), 5_000_000)}  # by bit depth

_SEQUENCE = struct.Struct("<BHBBIIIBB")
_TRIGGER_OUT = struct.Struct("<BBBII")
_CURRENT = struct.Struct("<HHH")
_INDEX = struct.Struct("<H")
_FRAME_PLANES = 24  # bit planes of one frame between the memory and the mirrors


class Command(IntEnum):
    """CMD1 in the high byte, CMD2 in the low one."""

    VERSION = 0x0100
    DISPLAY_MODE = 0x0101
    TEST_PATTERN = 0x0103
    LED_CURRENT = 0x0104
    DISPLAY_SETTING = 0x0107
    PATTERN = 0x0401
    START_STOP = 0x0402
    ADVANCE = 0x0403
    TRIGGER_OUT = 0x0404
    SHOW = 0x0405
    SEQUENCE = 0x0480

    @property
    def words(self) -> str:
        """How a person reads it."""
        return _WORDS[self]


_WORDS = {
    Command.VERSION: "read version",
    Command.DISPLAY_MODE: "display mode",
    Command.TEST_PATTERN: "test pattern",
    Command.LED_CURRENT: "LED current",
    Command.DISPLAY_SETTING: "display setting",
    Command.PATTERN: "pattern definition",
    Command.START_STOP: "start or stop the sequence",
    Command.ADVANCE: "advance to the next pattern",
    Command.TRIGGER_OUT: "trigger output",
    Command.SHOW: "show a pattern",
    Command.SEQUENCE: "sequence setting",
}


class ErrorCode(IntEnum):
    """What the payload of an error reply says."""

    FAILED = 1
    UNSUPPORTED = 2
    INVALID_PARAMETER = 3
    OUT_OF_MEMORY = 4
    DEVICE_FAILED = 5
    DEVICE_BUSY = 6
    NOT_INITIALISED = 7
    NOT_FOUND = 8
    CHECKSUM = 9
    PACKET_FORMAT = 10
    CONTINUATION = 11

    @property
    def words(self) -> str:
        """How a person reads it."""
        return self.name.lower().replace("_", " ")


class Chip(IntEnum):
    """Which version is asked for."""

    DM365 = 0x00
    FPGA = 0x10
    MSP430 = 0x20


class DisplayMode(IntEnum):
    """Where the picture comes from. Grey values are linear in pattern sequences alone."""

    STATIC_IMAGE = 0
    TEST_PATTERN = 1
    VIDEO = 2
    RESERVED = 3
    PATTERN_SEQUENCE = 4


class PatternType(IntEnum):
    NORMAL = 0
    INVERTED = 1
    HARDWARE = 2


class Trigger(IntEnum):
    """What shows the next pattern of a sequence."""

    COMMAND = 0
    AUTO = 1
    EXTERNAL = 2
    EXTERNAL_INVERTED = 3
    CAMERA = 4
    CAMERA_INVERTED = 5
    EXTERNAL_EXPOSURE = 6


class Led(IntEnum):
    RED = 0
    GREEN = 1
    BLUE = 2
    DEFAULT = 3  # of custom sequences only


@dataclass(frozen=True)
class Sequence:
    """Setting of a pattern sequence; all its patterns share it.

    Parameters
    ----------
    depth : int
        Bits per pattern, 1 to 8.
    count : int
        Number of patterns.
    trigger : int
        A ``Trigger``.
    period_us : int
        From pattern to pattern where the trigger is ``Trigger.AUTO``.
    exposure_us : int
        How long a pattern is shown.
    led : int
        A ``Led``.
    repeat : int
        1 to begin again after the last pattern, 0 to end with it.
    delay_us : int
        From the trigger to the pattern.
    pattern_type : int
        A ``PatternType``.
    """

    depth: int
    count: int
    trigger: int
    period_us: int
    exposure_us: int
    led: int
    repeat: int
    delay_us: int = 0
    pattern_type: int = PatternType.NORMAL


@dataclass(frozen=True)
class TriggerOut:
    """The pulse that tells a camera of each pattern."""

    enabled: int
    falling: int
    delay_us: int
    pulse_us: int
    source: int = 0


def pack_sequence(sequence: Sequence) -> bytes:
    """The payload of ``Command.SEQUENCE``, 19 bytes."""
    s = sequence
    return _SEQUENCE.pack(
        s.depth, s.count, s.pattern_type, s.trigger, s.delay_us, s.period_us, s.exposure_us, s.led, s.repeat
    )


def unpack_sequence(payload: bytes) -> Sequence:
    """Inverse of ``pack_sequence``. Raises struct.error for another length; values are as they came."""
    depth, count, pattern_type, trigger, delay_us, period_us, exposure_us, led, repeat = _SEQUENCE.unpack(payload)
    return Sequence(depth, count, trigger, period_us, exposure_us, led, repeat, delay_us, pattern_type)


def pack_trigger_out(trigger: TriggerOut) -> bytes:
    """The payload of ``Command.TRIGGER_OUT``, 11 bytes."""
    return _TRIGGER_OUT.pack(trigger.enabled, trigger.source, trigger.falling, trigger.delay_us, trigger.pulse_us)


def unpack_trigger_out(payload: bytes) -> TriggerOut:
    """Inverse of ``pack_trigger_out``. Raises struct.error for another length."""
    enabled, source, falling, delay_us, pulse_us = _TRIGGER_OUT.unpack(payload)
    return TriggerOut(enabled, falling, delay_us, pulse_us, source)


def pack_current(red: int, green: int, blue: int) -> bytes:
    """The payload of ``Command.LED_CURRENT``, 6 bytes."""
    return _CURRENT.pack(red, green, blue)


def unpack_current(payload: bytes) -> tuple[int, int, int]:
    """Red, green and blue. Raises struct.error for another length."""
    return _CURRENT.unpack(payload)


def pack_index(index: int) -> bytes:
    """The payload of ``Command.SHOW``, 2 bytes."""
    return _INDEX.pack(index)


def unpack_index(payload: bytes) -> int:
    """Inverse of ``pack_index``. Raises struct.error for another length."""
    return _INDEX.unpack(payload)[0]


def patterns_in_memory(depth: int) -> int:
    """How many patterns of ``depth`` bits fit in the memory; 5 bits take the room of 6, and 7 that of 8."""
    return BIT_PLANES // {5: 6, 7: 8}.get(depth, depth)


def batches(count: int, depth: int = 8) -> list[int]:
    """Cut ``count`` patterns into sequences that the device takes, the longest first: 24 of 8 bits are 12 and 12.

    TI's own software knows only sequences that fill one, two or four frames of at most 24 bit planes alike, with whole
    patterns: 1, 2, 3, 4, 6, 8 or 12 of 8 bits.
    """
    lengths = []
    while count > 0:
        lengths.append(
            max(n for n in range(1, min(count, patterns_in_memory(depth)) + 1) if _fills_frames(n * depth, depth))
        )
        count -= lengths[-1]
    return lengths


def _fills_frames(planes: int, depth: int) -> bool:
    return planes <= _FRAME_PLANES or any(
        planes % frames == 0 and planes // frames <= _FRAME_PLANES and planes // frames % depth == 0
        for frames in (2, 4)
    )
