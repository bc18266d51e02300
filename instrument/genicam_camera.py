"""Any GenICam camera, GigE Vision or USB3 Vision, through Aravis: one frame per software trigger, each accounted for.

A frame is handed out only if all its packets came, its number follows that of the frame before, it has the size and
the pixel format that were set, and, where the camera has a clock that can be read, it was exposed after the trigger.
"""

import ctypes
import ipaddress
import logging
import time
from collections.abc import Iterator
from contextlib import contextmanager
from ctypes import byref, c_int, c_size_t
from types import TracebackType
from typing import Annotated, Any, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from .aravis import (
    CONTINUOUS,
    NO_PACKET_SOCKET,
    OFF,
    PIXEL_FORMATS,
    REPLY_TIMEOUT_S,
    STATUS_NAMES,
    SUCCESS,
    AravisError,
    load,
)
from .contract import CameraNoise
from .device_errors import ConnectionLost, DeviceError, Fault, Rejected, TimedOut
from .errors import InputError
from .limits import check_within
from .rigfile import CameraSection
from .triggered_camera import CameraIdentity, Shot, joint_limits_us, noise_of

_log = logging.getLogger(__name__)

_BUFFERS = 4
_PACKET_TIMEOUT_US = 40_000  # after which a missing packet is asked for again
_RETENTION_SHARE = 0.5  # of a frame's time-out: how long a frame may lie incomplete
_RETENTION_MAX_US = 10_000_000
_FORMATS = {8: {"Mono8": 255.0}, 16: {"Mono16": 65535.0, "Mono12": 4095.0, "Mono10": 1023.0}}  # the best first
_CLOCKS = (("TimestampLatch", "TimestampLatchValue"), ("GevTimestampControlLatch", "GevTimestampValue"))
_UNPLUGGED = ("not connected", "transfer error", "not found", "not controller", "access denied")
_RECONNECT = "see to its power, its cable and that no other program has it, and run again"


class GenicamSettings(BaseModel):
    """``[genicam]`` of a rig file: which camera, and what of it.

    Parameters
    ----------
    address : str
        The camera's IPv4 address, or its name as ``arv-tool-0.8`` lists it.
    gain_db : float
        In the camera's own unit of its feature Gain, which the standard says is dB.
    first_row, first_col : int
        Where on the sensor the frames of the ``[camera]`` section's size begin.
    frame_timeout_s : float
        How long a frame may take beyond its exposure time.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)
    address: Annotated[str, Field(min_length=1, max_length=200, examples=["192.168.0.10"])]
    gain_db: Annotated[float, Field(ge=0, le=60)] = 0.0
    first_row: Annotated[int, Field(ge=0, le=20_000)] = 0
    first_col: Annotated[int, Field(ge=0, le=20_000)] = 0
    frame_timeout_s: Annotated[float, Field(gt=0, le=600)] = 5.0


class GenicamCamera:
    """An open camera; it satisfies ``TriggeredCamera`` and is a context manager.

    Parameters
    ----------
    section : CameraSection
        Size of the frames, bits, limits of exposure and noise, as the rig file states them. With 16 bits the best of
        Mono16, Mono12 and Mono10 that the camera offers is taken, and ``full_scale_dn`` is that format's.
    settings : GenicamSettings

    Raises
    ------
    InputError
        When Aravis is not installed, or the camera cannot do what the rig file asks for.
    DeviceError
        When the camera is not there, does not answer in time, or refuses.
    """

    def __init__(self, section: CameraSection, settings: GenicamSettings):
        self._aravis = load()
        self._section, self._settings = section, settings
        self._name = f"camera at {settings.address}"
        self._camera: Any = None
        self._stream: Any = None
        self._served = 0
        self._last_block: int | None = None
        if _is_address(settings.address):
            self._aravis("arv_disable_interface", "USB3Vision")  # nothing to look for there
        try:
            with self._command("connect"):
                self._camera = self._aravis("arv_camera_new", settings.address)
                self._device = self._aravis("arv_camera_get_device", self._camera)
                self.identity = self._read_identity()
            self._configure()
        except BaseException:
            self.close()
            raise

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, cols)."""
        return self._section.shape

    @property
    def full_scale_dn(self) -> float:
        return self._full_scale_dn

    @property
    def black_level_dn(self) -> float:
        return self._section.black_level_dn

    @property
    def noise(self) -> CameraNoise:
        return noise_of(self._section, self._full_scale_dn)

    @property
    def exposure_limits_us(self) -> tuple[float, float]:
        """What both the rig file and the camera allow."""
        return self._exposure_limits_us

    @property
    def exposure_us(self) -> float:
        """As the camera took it."""
        return self._exposure_us

    @exposure_us.setter
    def exposure_us(self, value: float) -> None:
        check_within(value, self._exposure_limits_us, "exposure time", "us")
        with self._command(f"set the exposure time to {value:g} us"):
            self._aravis("arv_camera_set_exposure_time", self._camera, float(value))
            self._exposure_us = self._aravis("arv_camera_get_exposure_time", self._camera)

    @property
    def gain_db(self) -> float:
        return self._gain_db

    def arm(self) -> None:
        """Make ready for triggers, with a stream that knows of no frame before."""
        self.disarm()
        aravis = self._aravis
        with self._command("start acquisition"):
            self._stream = aravis("arv_camera_create_stream", self._camera, None, None)
            payload = aravis("arv_camera_get_payload", self._camera)
            if aravis("arv_camera_is_gv_device", self._camera):
                retention_us = round(_RETENTION_SHARE * 1e6 * self._settings.frame_timeout_s)
                for name, kind, value in (
                    ("socket-buffer-size", "int", 2 * payload),  # the system may give less
                    ("packet-timeout", "uint", _PACKET_TIMEOUT_US),
                    ("packet-request-ratio", "double", 1.0),  # however many are missing
                    ("frame-retention", "uint", min(retention_us, _RETENTION_MAX_US)),
                ):
                    aravis.set_property(self._stream, name, kind, value)
            for _ in range(_BUFFERS):
                aravis("arv_stream_push_buffer", self._stream, aravis("arv_buffer_new_allocate", payload))
            self._last_block = None
            aravis("arv_camera_start_acquisition", self._camera)

    def trigger_and_grab(self) -> Shot:
        """Expose one frame from now on and wait for it.

        Frames that the camera's clock shows to be older than the trigger are passed over.

        Raises
        ------
        TimedOut
            When no frame comes within its exposure time and ``frame_timeout_s``, or the camera does not answer. With a
            camera that answers nothing the error comes up to ``REPLY_TIMEOUT_S`` later, for letting go of the stream.
        Fault
            When the frame is incomplete, another one is missing before it, or it is not what was set.
        """
        if self._stream is None:
            raise RuntimeError("arm the camera before triggering it")
        command = f"software trigger for frame {self._served}"
        with self._command(command):
            asked_ns = self._read_clock_ns()
            time_s = time.monotonic()
            self._aravis("arv_camera_software_trigger", self._camera)
            timeout_s = self._exposure_us / 1e6 + self._settings.frame_timeout_s
            image = None
            while image is None:
                left_us = max(0.0, time_s + timeout_s - time.monotonic()) * 1e6
                buffer = self._aravis("arv_stream_timeout_pop_buffer", self._stream, round(left_us))
                if buffer is None:
                    raise TimedOut(self._name, command, timeout_s, _RECONNECT, "the frame")
                try:
                    image = self._take(buffer, asked_ns, command)
                finally:
                    self._aravis("arv_stream_push_buffer", self._stream, buffer)
        shot = Shot(image, self._served, time_s)
        self._served += 1
        _log.debug("%s: frame %d, block %s", self._name, shot.serial, self._last_block)
        return shot

    def disarm(self) -> None:
        """Stop acquisition and forget the frames that are under way."""
        if self._stream is None:
            return
        try:
            with self._command("stop acquisition", disarm=False):
                self._aravis("arv_camera_stop_acquisition", self._camera)
        finally:
            self._drop_stream()

    def close(self) -> None:
        """Disarm and let go of the camera, also of one that no longer answers; a second call does nothing."""
        if self._camera is None:
            return
        try:
            self.disarm()
        except DeviceError as error:
            _log.warning("while closing: %s", error)
        finally:
            self._aravis("g_object_unref", self._camera)
            self._camera = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None, /
    ) -> None:
        self.close()

    def _read_identity(self) -> CameraIdentity:
        firmware = next((name for name in ("DeviceFirmwareVersion", "DeviceVersion") if self._offers(name)), None)
        text = self._aravis.text
        return CameraIdentity(
            vendor=text("arv_camera_get_vendor_name", self._camera),
            model=text("arv_camera_get_model_name", self._camera),
            serial=text("arv_camera_get_device_serial_number", self._camera),
            firmware=text("arv_device_get_string_feature_value", self._device, firmware) if firmware else "",
        )

    def _configure(self) -> None:
        """Everything that stays as it is: pixel format, region, trigger, gain; no automatism and no gamma."""
        aravis, camera, settings = self._aravis, self._camera, self._settings
        with self._command("configure"):
            if aravis("arv_camera_is_gv_device", camera):
                aravis("arv_camera_gv_set_stream_options", camera, NO_PACKET_SOCKET)
                self._ticks_per_s = aravis("arv_gv_device_get_timestamp_tick_frequency", self._device) or 10**9
            else:
                self._ticks_per_s = 10**9
            self._clock = next((names for names in _CLOCKS if all(map(self._offers, names))), None)
            if self._clock is None:
                _log.warning("%s has no clock that can be read: frames are told from older ones by number", self._name)
        self._choose_format()
        self._choose_region()
        with self._command("switch its automatisms off"):
            for kind in ("exposure", "gain"):
                if aravis(f"arv_camera_is_{kind}_auto_available", camera):
                    aravis(f"arv_camera_set_{'exposure_time' if kind == 'exposure' else kind}_auto", camera, OFF)
            if self._offers("GammaEnable"):
                aravis("arv_device_set_boolean_feature_value", self._device, "GammaEnable", 0)
            elif self._offers("Gamma"):
                aravis("arv_device_set_float_feature_value", self._device, "Gamma", 1.0)
        with self._command("software trigger"):
            aravis("arv_camera_set_acquisition_mode", camera, CONTINUOUS)
            aravis("arv_camera_set_trigger", camera, "Software")
        with self._command(f"set the gain to {settings.gain_db:g} dB"):
            self._gain_db = 0.0
            if aravis("arv_camera_is_gain_available", camera):
                check_within(settings.gain_db, aravis.limits("arv_camera_get_gain_bounds", camera), "gain", "dB")
                aravis("arv_camera_set_gain", camera, settings.gain_db)
                self._gain_db = aravis("arv_camera_get_gain", camera)
        with self._command("read its exposure times"):
            device_us = aravis.limits("arv_camera_get_exposure_time_bounds", camera)
        self._exposure_limits_us = joint_limits_us(self._section, device_us, self._name)
        with self._command("read its exposure time"):
            now_us = aravis("arv_camera_get_exposure_time", camera)
        self.exposure_us = float(np.clip(now_us, *self._exposure_limits_us))

    def _choose_format(self) -> None:
        with self._command("list its pixel formats"):
            offered = self._aravis.pixel_formats(self._camera)
        wanted = _FORMATS.get(self._section.bits, {})
        chosen = next((name for name in wanted if name in offered), None)
        if chosen is None:
            raise InputError(
                f"{self._name} offers the pixel formats {', '.join(offered) or 'none'}, and camera.bits = "
                f"{self._section.bits} asks for {' or '.join(wanted) or 'none that a camera has'}: set camera.bits to "
                "8 or 16 as the camera can."
            )
        self._full_scale_dn = wanted[chosen]
        self._pixel_code = PIXEL_FORMATS[chosen]
        with self._command(f"set the pixel format to {chosen}"):
            self._aravis("arv_camera_set_pixel_format", self._camera, self._pixel_code)

    def _choose_region(self) -> None:
        (rows, cols), settings = self.shape, self._settings
        region = settings.first_col, settings.first_row, cols, rows
        with self._command(f"set the region to {cols} x {rows} from column {region[0]}, row {region[1]}"):
            self._aravis("arv_camera_set_region", self._camera, *region)
            taken = [c_int() for _ in region]
            self._aravis("arv_camera_get_region", self._camera, *map(byref, taken))
        if tuple(value.value for value in taken) != region:
            x, y, width, height = (value.value for value in taken)
            raise InputError(
                f"{self._name} makes of a region of {cols} x {rows} from column {region[0]}, row {region[1]} one of "
                f"{width} x {height} from column {x}, row {y}: set camera.rows, camera.cols, genicam.first_row and "
                "genicam.first_col to what it can do."
            )

    def _take(self, buffer: int, asked_ns: int | None, command: str) -> np.ndarray | None:
        """A copy of the buffer's image; None where it was exposed before the trigger."""
        aravis = self._aravis
        status = aravis("arv_buffer_get_status", buffer)
        if status != SUCCESS:
            meaning = STATUS_NAMES.get(status, "unknown")
            raise Fault(self._name, command, f"buffer status {status}", meaning, "see to its cable and network card")
        block = aravis("arv_buffer_get_frame_id", buffer)
        older = asked_ns is not None and aravis("arv_buffer_get_timestamp", buffer) < asked_ns
        if older:
            _log.warning("%s: block %d was exposed before it was asked for and is passed over", self._name, block)
            if self._last_block is None:
                return None  # from before the camera was armed: its number says nothing
        if self._last_block is not None and not _follows(block, self._last_block):
            meaning = f"block {block} came after block {self._last_block}"
            raise Fault(self._name, command, "frames lost", meaning, "see to its cable and network card, and run again")
        self._last_block = block
        if older:
            return None
        got = tuple(aravis(f"arv_buffer_get_image_{what}", buffer) for what in ("height", "width", "pixel_format"))
        if got != (*self.shape, self._pixel_code):
            meaning = f"{got[1]} x {got[0]} of pixel format {got[2]:#x}"
            raise Fault(self._name, command, "not the frame that was set", meaning, "let no other program change it")
        dtype = np.dtype(np.uint8 if self._section.bits == 8 else "<u2")
        size = c_size_t()
        data = aravis("arv_buffer_get_image_data", buffer, byref(size))
        wanted = self.shape[0] * self.shape[1] * dtype.itemsize
        if size.value < wanted:
            meaning = f"{size.value} bytes instead of {wanted}"
            raise Fault(self._name, command, "short frame", meaning, "see to its cable and network card, and run again")
        return np.frombuffer(ctypes.string_at(data, wanted), dtype).reshape(self.shape).copy()

    def _read_clock_ns(self) -> int | None:
        if self._clock is None:
            return None
        latch, value = self._clock
        self._aravis("arv_device_execute_command", self._device, latch)
        ticks = self._aravis("arv_device_get_integer_feature_value", self._device, value)
        return ticks if self._ticks_per_s == 10**9 else ticks * 10**9 // self._ticks_per_s

    def _offers(self, feature: str) -> bool:
        return bool(self._aravis("arv_device_is_feature_available", self._device, feature))

    def _drop_stream(self) -> None:
        if self._stream is not None:
            self._aravis("g_object_unref", self._stream)  # with its thread and its buffers
            self._stream = None

    @contextmanager
    def _command(self, command: str, disarm: bool = True) -> Iterator[None]:
        """Names device and command in whatever goes wrong, and lets the camera not stay armed then."""
        _log.debug("%s: %s", self._name, command)
        try:
            yield
        except (AravisError, DeviceError) as error:
            if disarm:
                self._drop_stream()
            if isinstance(error, DeviceError):
                raise
            raise self._typed(error, command) from None

    def _typed(self, error: AravisError, command: str) -> DeviceError:
        if error.name == "timeout":
            return TimedOut(self._name, command, REPLY_TIMEOUT_S, _RECONNECT)
        if error.name in _UNPLUGGED:
            return ConnectionLost(self._name, command, error.message, _RECONNECT)
        remedy = "compare the rig file with what the camera can do, as arv-tool-0.8 shows"
        return Rejected(self._name, command, error.name, error.message, remedy)


def _follows(block: int, last: int) -> bool:
    """Whether a frame's number comes next: numbers of 16 bits go on with 1 after the greatest."""
    return block == last + 1 or (last == 0xFFFF and block == 1)


def _is_address(text: str) -> bool:
    try:
        ipaddress.ip_address(text)
    except ValueError:
        return False
    return True
