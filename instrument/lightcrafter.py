"""Driver of the TI DLP LightCrafter: 8-bit pattern sequences through its DM365 over TCP.

Patterns are shown in pattern-sequence mode alone, where the light is linear in the grey value; the modes for static
images and video bend the grey scale, and this driver never selects them.
"""

import logging
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np

from .device_errors import DeviceError, Rejected
from .errors import InputError
from .lightcrafter_bitmap import encode_bitmap
from .lightcrafter_commands import (
    LOAD_US,
    LONGEST_EXPOSURE_US,
    LONGEST_US,
    PORT,
    SHAPE,
    SHORTEST_EXPOSURE_US,
    Chip,
    Command,
    DisplayMode,
    Led,
    Sequence,
    Trigger,
    TriggerOut,
    batches,
    pack_current,
    pack_index,
    pack_sequence,
    pack_trigger_out,
    patterns_in_memory,
    unpack_current,
)
from .lightcrafter_link import Link
from .limits import check_patterns, check_within

DEPTH = 8

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True)
class LightCrafterSettings:
    """How a LightCrafter is reached and used.

    Parameters
    ----------
    host, port : str, int
        Its address; the defaults are those it leaves the factory with.
    led : Led
        The LED that lights the patterns.
    led_current : tuple of 3 ints
        Of the red, green and blue LED, in the device's own steps.
    led_current_max : int
        The largest of these that is allowed; 255 is the largest that public software sends.
    trigger : Trigger
        What shows the next pattern: ``Trigger.COMMAND`` is ``advance`` and ``show``.
    repeat : bool
        Whether the sequence begins again after its last pattern.
    trigger_out : TriggerOut
        The pulse that the device gives a camera with each pattern.
    long_axis_flip, short_axis_flip : bool
        How the picture is turned on the mirrors.
    exposure_max_us : int
        The longest exposure; older firmware ends at 20 000.
    timeout_s, busy_s : float
        How long a connection or a reply may take, and how long a device that says it is busy is asked again.
    """

    host: str = "192.168.1.100"
    port: int = PORT
    led: Led = Led.GREEN
    led_current: tuple[int, int, int] = (255, 255, 255)
    led_current_max: int = 255
    trigger: Trigger = Trigger.COMMAND
    repeat: bool = True
    trigger_out: TriggerOut = field(default=TriggerOut(enabled=1, falling=0, delay_us=0, pulse_us=200))
    long_axis_flip: bool = False
    short_axis_flip: bool = False
    exposure_max_us: int = LONGEST_EXPOSURE_US[DEPTH]
    timeout_s: float = 5.0
    busy_s: float = 5.0


@dataclass(frozen=True)
class Versions:
    """What the device says of itself."""

    dm365: str
    fpga: str
    msp430: str


class LightCrafter:
    """A LightCrafter; a context manager that connects, and leaves it dark.

    Entering stops whatever is shown and lights nothing. Leaving stops the sequence; so does every error, over a new
    connection where the old one is unusable, before it is raised. The raised error comes at most ``busy_s`` and four
    times ``timeout_s`` after the call for one packet.

    Parameters
    ----------
    settings : LightCrafterSettings

    Raises
    ------
    InputError
        For LED currents outside their limits.
    """

    shape = SHAPE
    capacity = patterns_in_memory(DEPTH)

    def __init__(self, settings: LightCrafterSettings) -> None:
        self._settings = settings
        self._check_current(settings.led_current)
        self._link = Link(settings.host, settings.port, settings.timeout_s, settings.busy_s)
        self._sequence = Sequence(
            depth=DEPTH,
            count=0,
            trigger=settings.trigger,
            period_us=0,
            exposure_us=SHORTEST_EXPOSURE_US[DEPTH],
            led=settings.led,
            repeat=int(settings.repeat),
        )
        self.set_timing(SHORTEST_EXPOSURE_US[DEPTH])
        self._sent: Sequence | None = None  # as the device has it
        self._dark = False  # known to be
        self.versions = Versions("", "", "")

    def __enter__(self) -> Self:
        """Connect, make it dark, read the versions, and set what holds for all sequences.

        Raises
        ------
        DeviceError
            When it cannot be reached or does not take a setting.
        """
        settings = self._settings
        self._forget()
        self._dark = False
        self._link.open()
        try:
            self._write(Command.DISPLAY_MODE, bytes([DisplayMode.PATTERN_SEQUENCE]))
            try:
                self._link.write(Command.START_STOP, b"\0")
            except Rejected as refusal:  # there is nothing to stop; TI's software does not look at the answer either
                _LOG.info("%s", refusal)
            self._dark = True
            self.versions = Versions(*(self._version(chip) for chip in (Chip.DM365, Chip.FPGA, Chip.MSP430)))
            self.set_led_current(*settings.led_current)
            self._write(Command.DISPLAY_SETTING, bytes([settings.long_axis_flip, settings.short_axis_flip, 0]))
            self._write(Command.TRIGGER_OUT, pack_trigger_out(settings.trigger_out))
        except BaseException:
            self._link.close()
            raise
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, traceback: object) -> None:
        """Make it dark and disconnect. Raises DeviceError when it may still be lit and nothing else was raised."""
        try:
            self.darken()
        except DeviceError as failure:
            if error is None:
                raise
            _LOG.warning("%s", failure)
        finally:
            self._link.close()

    @property
    def exposure_limits_us(self) -> tuple[float, float]:
        """Of an 8-bit pattern. Below the first the device would silently raise it."""
        return float(SHORTEST_EXPOSURE_US[DEPTH]), float(self._settings.exposure_max_us)

    @property
    def exposure_us(self) -> float:
        """How long a pattern is shown."""
        return float(self._sequence.exposure_us)

    @property
    def period_us(self) -> float:
        """From pattern to pattern; 0 where something else than time shows the next one."""
        return float(self._sequence.period_us)

    def set_timing(self, exposure_us: float, period_us: float | None = None) -> None:
        """Set the exposure, and the period of a sequence that runs by itself; both hold from
        the next ``start``, or ``show`` out of the dark.

        Parameters
        ----------
        exposure_us : float
            Within ``exposure_limits_us``; whole microseconds are sent.
        period_us : float, optional
            At least the exposure. Default is the exposure and the time to load a pattern.

        Raises
        ------
        InputError
            Outside the limits, before anything is sent.
        """
        check_within(exposure_us, self.exposure_limits_us, "projector exposure", "us")
        period_us = exposure_us + LOAD_US if period_us is None else period_us
        check_within(period_us, (exposure_us, LONGEST_US), "projector period", "us")
        automatic = self._sequence.trigger == Trigger.AUTO
        self._sequence = replace(
            self._sequence, exposure_us=round(exposure_us), period_us=round(period_us) if automatic else 0
        )

    def led_current(self) -> tuple[int, int, int]:
        """Of the red, green and blue LED, as the device reports it."""
        return unpack_current(self._read(Command.LED_CURRENT, size=6))

    def set_led_current(self, red: int, green: int, blue: int) -> None:
        """Set it, for the LEDs that are lit by patterns. Raises InputError outside 0 to ``led_current_max``."""
        self._check_current((red, green, blue))
        self._write(Command.LED_CURRENT, pack_current(red, green, blue))

    def set_trigger_out(self, trigger: TriggerOut) -> None:
        """Set the pulse that the device gives a camera with each pattern.

        Raises
        ------
        InputError
            For times that do not fit on the wire, before anything is sent.
        """
        check_within(trigger.delay_us, (0, LONGEST_US), "delay of the projector's trigger output", "us")
        check_within(trigger.pulse_us, (0, LONGEST_US), "pulse of the projector's trigger output", "us")
        self._write(Command.TRIGGER_OUT, pack_trigger_out(trigger))

    def upload(self, patterns: np.ndarray) -> None:
        """Put patterns in the device's memory in place of those it has; it is dark meanwhile and afterwards.

        Parameters
        ----------
        patterns : (N, 684, 608) uint8
            At most ``capacity``; ``in_batches`` cuts longer sequences.

        Raises
        ------
        InputError
            For another shape, or more patterns than the memory holds, before anything is sent.
        DeviceError
            When the device does not take them. None of them can then be shown.
        """
        check_patterns(patterns, self.shape)
        if len(patterns) > self.capacity:
            raise InputError(
                f"{len(patterns)} patterns do not fit in the projector's memory, which holds 1 to {self.capacity} of "
                f"{DEPTH} bits: upload them in batches"
            )
        self._sequence = replace(self._sequence, count=0)
        if not self._dark:
            self.stop()
        self._send_sequence(replace(self._sequence, count=len(patterns)))
        for index, pattern in enumerate(patterns):
            self._write(Command.PATTERN, bytes([index]) + encode_bitmap(pattern, DEPTH))
        self._sequence = replace(self._sequence, count=len(patterns))

    def start(self) -> None:
        """Start the sequence with its first pattern, lit at once or by the trigger that was set.

        Raises
        ------
        InputError
            When there are no patterns.
        DeviceError
            When the device does not start. It is dark then, or says not to be.
        """
        self._check_index(0)
        if self._sent != self._sequence:
            self._send_sequence(self._sequence)
        self._light(Command.START_STOP, b"\1")

    def advance(self) -> None:
        """Show the next pattern of a started sequence. Raises InputError where another trigger than this one is set."""
        if self._sequence.trigger != Trigger.COMMAND:
            trigger = Trigger(self._sequence.trigger).name.lower()
            raise InputError(
                f"the projector's patterns follow its {trigger} trigger and cannot be advanced: set it to command"
            )
        self._check_index(0)
        self._light(Command.ADVANCE, b"")

    def show(self, index: int) -> None:
        """Show pattern ``index``, from 0, until another is shown. Raises InputError for one that is not there."""
        self._check_index(index)
        if self._dark and self._sent != self._sequence:
            self._send_sequence(self._sequence)
        self._light(Command.SHOW, pack_index(index))

    def stop(self) -> None:
        """Make it dark; the patterns stay in its memory."""
        self._write(Command.START_STOP, b"\0")
        self._dark = True

    def _send_sequence(self, sequence: Sequence) -> None:
        self._sent = None
        self._write(Command.SEQUENCE, pack_sequence(sequence))
        self._sent = sequence

    def _light(self, command: Command, payload: bytes) -> None:
        self._dark = False
        self._write(command, payload)

    def _write(self, command: Command, payload: bytes) -> None:
        try:
            self._link.write(command, payload)
        except BaseException:
            self._darken_after_failure()
            raise

    def _read(self, command: Command, payload: bytes = b"", size: int | None = None) -> bytes:
        try:
            return self._link.read(command, payload, size)
        except BaseException:
            self._darken_after_failure()
            raise

    def _darken_after_failure(self) -> None:
        try:
            self.darken()
        except DeviceError as failure:
            _LOG.warning("%s", failure)

    def darken(self) -> None:
        """Make it dark if it may be lit: over a new connection where there is none, which is closed again."""
        if self._dark:
            return
        if self._link.is_open:
            self._link.write(Command.START_STOP, b"\0")
        else:
            self._link.open()
            try:
                self._link.write(Command.START_STOP, b"\0")
            finally:
                self._link.close()
        self._dark = True

    def _forget(self) -> None:
        """What the device had been sent."""
        self._sent = None
        self._sequence = replace(self._sequence, count=0)

    def _version(self, chip: Chip) -> str:
        text = self._read(Command.VERSION, bytes([chip])).split(b"\0")[0]
        return text.decode("ascii", errors="replace").strip()

    def _check_current(self, currents: tuple[int, int, int]) -> None:
        for led, current in zip(("red", "green", "blue"), currents, strict=True):
            check_within(current, (0, self._settings.led_current_max), f"current of the projector's {led} LED", "steps")

    def _check_index(self, index: int) -> None:
        if not 0 <= index < self._sequence.count:
            held = f"0 to {self._sequence.count - 1}" if self._sequence.count else "none"
            raise InputError(f"the projector has no pattern {index} to show: it holds {held}; upload patterns first")


def in_batches(patterns: np.ndarray) -> list[np.ndarray]:
    """Cut (N, rows, cols) patterns into the sequences that ``LightCrafter.upload`` takes: 24 into 12 and 12."""
    ends = np.cumsum(batches(len(patterns), DEPTH))
    return np.split(patterns, ends[:-1])
