"""What a LightCrafter does with requests, and what it then shows: the emulated device without its wire.

Where nothing public says what the device does, this one refuses: its answer to a command that comes at the wrong moment
is the error "not initialised", and what it does not know is "unsupported". Hardware patterns, video, static images,
stored solutions and custom sequences are not emulated.
"""

import struct
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from greenough.instrument.lightcrafter_bitmap import BadBitmap, bitmap_bytes, decode_bitmap, encode_bitmap
from greenough.instrument.lightcrafter_commands import (
    LONGEST_EXPOSURE_US,
    SHAPE,
    SHORTEST_EXPOSURE_US,
    Chip,
    Command,
    DisplayMode,
    ErrorCode,
    PatternType,
    Sequence,
    Trigger,
    TriggerOut,
    pack_current,
    pack_sequence,
    pack_trigger_out,
    patterns_in_memory,
    unpack_current,
    unpack_index,
    unpack_sequence,
    unpack_trigger_out,
)

LONGEST_PAYLOAD = 1 + bitmap_bytes(SHAPE, 8)  # of all requests: an index and a bitmap
VERSIONS = {Chip.DM365: "DM365 4.0 (emulated)", Chip.FPGA: "FPGA (emulated)", Chip.MSP430: "MSP430 (emulated)"}
_VERSION_BYTES = 32
_TEST_PATTERNS = 14


class Refusal(Exception):
    """The device refuses a request with ``code``."""

    def __init__(self, code: ErrorCode):
        super().__init__(code)
        self.code = code


@dataclass(frozen=True)
class Shown:
    """What the mirrors show.

    Parameters
    ----------
    index : int
        Which of the patterns.
    patterns : (N, 684, 608) uint8
        All patterns of the sequence as the mirrors show them, in grey values from 0 to 255. Not to be written.
    upload : int
        Grows with every change of the patterns, so that work on them can be kept.
    sequence : Sequence
        The setting, its exposure raised to what the device can.
    led_current : tuple of 3 ints
        Red, green, blue.
    """

    index: int
    patterns: np.ndarray = field(compare=False)
    upload: int
    sequence: Sequence
    led_current: tuple[int, int, int]


class LightCrafterDevice:
    """An emulated LightCrafter, as it stands after power-up: showing a picture of its own.

    Parameters
    ----------
    on_display : callable of Shown or None, optional
        Called with what is shown by every command that changes it, before it is answered; None is the dark, or a
        picture that is no pattern. A sequence that runs by time changes without a call.
    clock : callable
        Time in s, by which automatic sequences run.
    """

    def __init__(
        self,
        on_display: Callable[[Shown | None], None] = lambda shown: None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._on_display = on_display
        self._clock = clock
        self._lock = threading.RLock()
        self._mode = DisplayMode.STATIC_IMAGE
        self._test_pattern = 0
        self._led_current = (0, 0, 0)
        self._flips = (0, 0)
        self._trigger_out = TriggerOut(enabled=0, falling=0, delay_us=0, pulse_us=0)
        self._sequence: Sequence | None = None
        self._memory: dict[int, np.ndarray] = {}
        self._upload = 0
        self._stack: tuple[int, np.ndarray] | None = None  # of that upload
        self._index: int | None = None  # shown, or the first of a sequence that runs by time
        self._started: float | None = None  # the sequence, by the clock

    @property
    def lit(self) -> bool:
        """Whether light leaves it, from patterns or from anything else."""
        with self._lock:
            return self._mode != DisplayMode.PATTERN_SEQUENCE or self.shown is not None

    @property
    def led_current(self) -> tuple[int, int, int]:
        """Red, green, blue."""
        return self._led_current

    @property
    def trigger_out(self) -> TriggerOut:
        """The pulse for a camera."""
        return self._trigger_out

    @property
    def shown(self) -> Shown | None:
        """What is shown now; None in the dark and outside pattern sequences."""
        with self._lock:
            sequence, index = self._sequence, self._index
            if sequence is None or index is None or self._started is None:
                return None
            if sequence.trigger == Trigger.AUTO:
                index, within_us = divmod((self._clock() - self._started) * 1e6, sequence.period_us)
                index = int(index)
                if (index >= sequence.count and not sequence.repeat) or within_us >= sequence.exposure_us:
                    return None
                index %= sequence.count
            return Shown(index, self._patterns(sequence), self._upload, sequence, self._led_current)

    def trigger(self) -> None:
        """A pulse at the trigger input: the next pattern of a started sequence that waits for one."""
        with self._lock:
            sequence = self._sequence
            if sequence is None or self._started is None or sequence.trigger in (Trigger.COMMAND, Trigger.AUTO):
                return
            self._step(sequence)

    def read(self, command: int, payload: bytes) -> bytes:
        """The answer to a question. Raises Refusal."""
        with self._lock:
            if command == Command.VERSION:
                if len(payload) != 1:
                    raise Refusal(ErrorCode.PACKET_FORMAT)
                if payload[0] not in tuple(VERSIONS):
                    raise Refusal(ErrorCode.INVALID_PARAMETER)
                return VERSIONS[Chip(payload[0])].encode().ljust(_VERSION_BYTES, b"\0")
            if command == Command.PATTERN:
                if len(payload) != 1:
                    raise Refusal(ErrorCode.PACKET_FORMAT)
                if self._sequence is None or payload[0] not in self._memory:
                    raise Refusal(ErrorCode.NOT_FOUND)
                return self._stored(self._sequence.depth, payload[0])
            answers: dict[int, Callable[[], bytes]] = {
                Command.DISPLAY_MODE: lambda: bytes([self._mode]),
                Command.TEST_PATTERN: lambda: bytes([self._test_pattern]),
                Command.LED_CURRENT: lambda: pack_current(*self._led_current),
                Command.DISPLAY_SETTING: lambda: bytes([*self._flips, 0]),
                Command.SEQUENCE: self._packed_sequence,
                Command.TRIGGER_OUT: lambda: pack_trigger_out(self._trigger_out),
            }
            if command not in answers:
                raise Refusal(ErrorCode.UNSUPPORTED)
            if payload not in (b"", b"\0"):  # both are in the field
                raise Refusal(ErrorCode.PACKET_FORMAT)
            return answers[command]()

    def write(self, command: int, payload: bytes) -> None:
        """Do what a request says. Raises Refusal, and has then done nothing."""
        actions: dict[int, Callable[[bytes], None]] = {
            Command.DISPLAY_MODE: self._set_mode,
            Command.TEST_PATTERN: self._set_test_pattern,
            Command.LED_CURRENT: self._set_led_current,
            Command.DISPLAY_SETTING: self._set_flips,
            Command.SEQUENCE: self._set_sequence,
            Command.PATTERN: self._define,
            Command.START_STOP: self._start_or_stop,
            Command.ADVANCE: self._advance,
            Command.TRIGGER_OUT: self._set_trigger_out,
            Command.SHOW: self._show,
        }
        if command not in actions:
            raise Refusal(ErrorCode.UNSUPPORTED)
        with self._lock:
            try:
                actions[command](payload)
            except struct.error:
                raise Refusal(ErrorCode.PACKET_FORMAT) from None

    def _packed_sequence(self) -> bytes:
        if self._sequence is None:
            raise Refusal(ErrorCode.NOT_INITIALISED)
        return pack_sequence(self._sequence)

    def _set_mode(self, payload: bytes) -> None:
        mode = _one_of(payload, len(DisplayMode))
        self._go_dark()
        self._mode = DisplayMode(mode)

    def _set_test_pattern(self, payload: bytes) -> None:
        self._test_pattern = _one_of(payload, _TEST_PATTERNS)

    def _set_led_current(self, payload: bytes) -> None:
        self._led_current = unpack_current(payload)
        if self._index is not None:
            self._on_display(self.shown)

    def _set_flips(self, payload: bytes) -> None:
        long_axis, short_axis, rotated = struct.unpack("<BBB", payload)
        if max(long_axis, short_axis) > 1 or rotated:
            raise Refusal(ErrorCode.INVALID_PARAMETER)
        self._flips = (long_axis, short_axis)
        self._patterns_changed()

    def _set_sequence(self, payload: bytes) -> None:
        new = unpack_sequence(payload)
        if new.depth not in SHORTEST_EXPOSURE_US or new.count == 0:
            raise Refusal(ErrorCode.INVALID_PARAMETER)
        if new.count > patterns_in_memory(new.depth):
            raise Refusal(ErrorCode.OUT_OF_MEMORY)
        if new.pattern_type == PatternType.HARDWARE:
            raise Refusal(ErrorCode.UNSUPPORTED)
        new = replace(new, exposure_us=max(new.exposure_us, SHORTEST_EXPOSURE_US[new.depth]))
        if (
            new.pattern_type > PatternType.HARDWARE
            or new.trigger > Trigger.EXTERNAL_EXPOSURE
            or new.led > 3
            or new.repeat > 1
            or new.exposure_us > LONGEST_EXPOSURE_US[new.depth]
            or (new.trigger == Trigger.AUTO and new.period_us < new.exposure_us)
        ):
            raise Refusal(ErrorCode.INVALID_PARAMETER)
        self._go_dark()
        if self._sequence is None or new.depth != self._sequence.depth:
            self._memory.clear()
        self._sequence = new
        self._patterns_changed()

    def _define(self, payload: bytes) -> None:
        if self._sequence is None or self._mode != DisplayMode.PATTERN_SEQUENCE:
            raise Refusal(ErrorCode.NOT_INITIALISED)
        depth = self._sequence.depth
        if len(payload) != 1 + bitmap_bytes(SHAPE, depth):
            raise Refusal(ErrorCode.PACKET_FORMAT)
        if payload[0] >= self._sequence.count:
            raise Refusal(ErrorCode.INVALID_PARAMETER)
        try:
            grey = decode_bitmap(payload[1:], SHAPE, depth)
        except BadBitmap:
            raise Refusal(ErrorCode.INVALID_PARAMETER) from None
        self._memory[payload[0]] = grey
        self._patterns_changed()

    def _start_or_stop(self, payload: bytes) -> None:
        if not _one_of(payload, 2):
            self._go_dark()
            return
        sequence = self._ready()
        self._started = self._clock()
        self._index = 0 if sequence.trigger in (Trigger.COMMAND, Trigger.AUTO) else None
        self._on_display(self.shown)

    def _advance(self, payload: bytes) -> None:
        if payload not in (b"", b"\0"):  # both are in the field
            raise Refusal(ErrorCode.PACKET_FORMAT)
        sequence = self._ready()
        if sequence.trigger != Trigger.COMMAND or self._index is None:
            raise Refusal(ErrorCode.NOT_INITIALISED)
        self._step(sequence)

    def _show(self, payload: bytes) -> None:
        index = unpack_index(payload)
        sequence = self._ready()
        if sequence.trigger == Trigger.AUTO:
            raise Refusal(ErrorCode.NOT_INITIALISED)
        if index >= sequence.count:
            raise Refusal(ErrorCode.INVALID_PARAMETER)
        self._index, self._started = index, self._clock()
        self._on_display(self.shown)

    def _set_trigger_out(self, payload: bytes) -> None:
        trigger = unpack_trigger_out(payload)
        if max(trigger.enabled, trigger.falling) > 1 or trigger.source:
            raise Refusal(ErrorCode.INVALID_PARAMETER)
        self._trigger_out = trigger

    def _ready(self) -> Sequence:
        """The sequence, if all of its patterns are there."""
        sequence = self._sequence
        if (
            sequence is None
            or self._mode != DisplayMode.PATTERN_SEQUENCE
            or not all(index in self._memory for index in range(sequence.count))
        ):
            raise Refusal(ErrorCode.NOT_INITIALISED)
        return sequence

    def _step(self, sequence: Sequence) -> None:
        index = 0 if self._index is None else self._index + 1
        if index == sequence.count and not sequence.repeat:
            self._go_dark()
            return
        self._index = index % sequence.count
        self._on_display(self.shown)

    def _go_dark(self) -> None:
        was_lit, self._index, self._started = self._index is not None, None, None
        if was_lit:
            self._on_display(None)

    def _patterns_changed(self) -> None:
        self._upload += 1
        self._stack = None
        if self._index is not None:
            self._on_display(self.shown)

    def _patterns(self, sequence: Sequence) -> np.ndarray:
        if self._stack is None or self._stack[0] != self._upload:
            stack = np.stack([self._memory.get(n, np.zeros(SHAPE, np.uint8)) for n in range(sequence.count)])
            if sequence.pattern_type == PatternType.INVERTED:
                stack = 255 - stack
            long_axis, short_axis = self._flips
            stack = stack[:, :: -1 if short_axis else 1, :: -1 if long_axis else 1]
            stack.flags.writeable = False
            self._stack = (self._upload, stack)
        return self._stack[1]

    def _stored(self, depth: int, index: int) -> bytes:
        levels = np.rint(self._memory[index] * ((2**depth - 1) / 255)).astype(np.uint8)
        return encode_bitmap(levels, depth)


def _one_of(payload: bytes, count: int) -> int:
    """The one byte of a payload, below ``count``."""
    if len(payload) != 1:
        raise Refusal(ErrorCode.PACKET_FORMAT)
    if payload[0] >= count:
        raise Refusal(ErrorCode.INVALID_PARAMETER)
    return payload[0]
