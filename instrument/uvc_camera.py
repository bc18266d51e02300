"""A UVC camera such as The Imaging Source's DMK 23U445: one frame per trigger, and never one from before it.

Two layers are passed in: ``Capture`` gives frames, ``Controls`` sets what the camera has. ``open_uvc_camera`` takes
OpenCV's and Video4Linux's. With the vendor's software trigger the camera exposes when it is told to; without, it runs
freely and frames are passed over until one was exposed wholly after it was asked for.
"""

import logging
import math
import time
from types import TracebackType
from typing import Annotated, Protocol, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from . import v4l2_controls as v4l2
from .contract import CameraNoise
from .device_errors import DeviceError, Fault, TimedOut
from .errors import InputError
from .limits import check_within
from .rigfile import CameraSection
from .triggered_camera import CameraIdentity, Shot, joint_limits_us, noise_of
from .v4l2_capture import CapturedFrame, V4l2Capture

_log = logging.getLogger(__name__)
_REMEDY = "see to its plug and that no other program has it, and run again"
_QUEUED_MAX = 100  # frames passed over when arming: a camera that sends more does not heed its trigger mode


class UvcSettings(BaseModel):
    """``[uvc]`` of a rig file: which camera, and what of it.

    Parameters
    ----------
    device : str
        ``/dev/video0``, better ``/dev/v4l/by-id/...``.
    gain_db : float
        Only 0 where the camera has no gain in dB.
    frame_timeout_s : float
        How long a frame may take beyond its exposure time.
    readout_s : float
        How long a frame may take from the end of its exposure until the kernel sees it. Too short a time lets a camera
        without a trigger give frames of the pattern before.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)
    device: Annotated[str, Field(min_length=1, max_length=200, examples=["/dev/video0"])]
    gain_db: Annotated[float, Field(ge=0, le=60)] = 0.0
    frame_timeout_s: Annotated[float, Field(gt=0, le=600)] = 2.0
    readout_s: Annotated[float, Field(ge=0, le=10)] = 0.1


class Capture(Protocol):
    """Where frames come from, in the order in which they were exposed."""

    def read(self, timeout_s: float) -> CapturedFrame | None:
        """The next frame of the queue; None when none comes within ``timeout_s``."""
        ...

    def close(self) -> None: ...


class Controls(Protocol):
    """What can be set, by the ids of ``v4l2_controls``."""

    def identity(self) -> CameraIdentity: ...

    def limits(self, control: int) -> tuple[int, int] | None:
        """Least and greatest value; None where the camera does not have it."""
        ...

    def get(self, control: int) -> int: ...

    def set(self, control: int, value: int) -> None: ...

    def close(self) -> None: ...


def open_uvc_camera(section: CameraSection, settings: UvcSettings) -> "UvcCamera":
    """The camera at a device file.

    Raises
    ------
    InputError
        When the camera cannot do what the rig file asks for.
    DeviceError
        When it is not there, or refuses.
    """
    controls = v4l2.V4l2Controls(settings.device)
    try:
        return UvcCamera(section, settings, V4l2Capture(settings.device, section.shape, section.bits), controls)
    except BaseException:
        controls.close()
        raise


class UvcCamera:
    """An open camera; it satisfies ``TriggeredCamera`` and is a context manager.

    Parameters
    ----------
    section : CameraSection
        Size of the frames, bits, limits of exposure and noise, as the rig file states them.
    settings : UvcSettings
    capture : Capture
    controls : Controls
        Both are the camera's own from now on, and are closed with it.

    Raises
    ------
    InputError
        When the camera cannot do what the rig file asks for.
    DeviceError
        When it does not answer, or refuses.
    """

    def __init__(self, section: CameraSection, settings: UvcSettings, capture: Capture, controls: Controls):
        self._section, self._settings = section, settings
        self._capture, self._controls = capture, controls
        self._name = f"camera at {settings.device}"
        self._armed = self._closed = self._overdue = False
        self._served = 0
        try:
            self.identity = controls.identity()
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
        return self._section.full_scale_dn

    @property
    def black_level_dn(self) -> float:
        return self._section.black_level_dn

    @property
    def noise(self) -> CameraNoise:
        return noise_of(self._section, self.full_scale_dn)

    @property
    def exposure_limits_us(self) -> tuple[float, float]:
        """What both the rig file and the camera allow."""
        return self._exposure_limits_us

    @property
    def exposure_us(self) -> float:
        """As the camera took it: in whole microseconds, or whole 100 us without the vendor's control."""
        return self._exposure_us

    @exposure_us.setter
    def exposure_us(self, value: float) -> None:
        check_within(value, self._exposure_limits_us, "exposure time", "us")
        self._controls.set(self._exposure_control, round(value / self._exposure_unit_us))
        self._exposure_us = float(self._controls.get(self._exposure_control) * self._exposure_unit_us)

    @property
    def gain_db(self) -> float:
        """0 where the camera has no gain in dB: it is left as it is then."""
        return self._gain_db

    def arm(self) -> None:
        """Make ready for triggers; frames that are under way, as long as they may be, are waited for and forgotten."""
        self._armed = False
        if self._triggered:
            quiet_s = self._exposure_us / 1e6 + self._settings.readout_s
            if self._overdue:
                quiet_s += self._settings.frame_timeout_s
            for _ in range(_QUEUED_MAX):
                if self._capture.read(quiet_s) is None:
                    break
            else:
                meaning = "frames come without a trigger"
                raise Fault(self._name, "arm", "trigger mode", meaning, "unplug it, plug it in again and run again")
        self._overdue = False
        self._armed = True

    def trigger_and_grab(self) -> Shot:
        """Expose one frame from now on and wait for it; frames from before are passed over.

        Raises
        ------
        TimedOut
            When none comes within its exposure time and ``frame_timeout_s``. The next ``arm`` waits for it that long.
        Fault
            When it is not of the size and type that were set.
        """
        if not self._armed:
            raise RuntimeError("arm the camera before triggering it")
        command = f"trigger for frame {self._served}"
        try:
            asked_s = time.monotonic()
            if self._triggered:
                self._controls.set(v4l2.SOFTWARE_TRIGGER, 1)
            image = self._fresh_image(asked_s, command)
        except DeviceError as error:
            self._armed = False
            self._overdue = isinstance(error, TimedOut)
            raise
        shot = Shot(image, self._served, asked_s)
        self._served += 1
        return shot

    def disarm(self) -> None:
        """Take no more frames."""
        self._armed = False

    def close(self) -> None:
        """Let go of the camera, and let it run freely again; a second call does nothing."""
        if self._closed:
            return
        self._closed, self._armed = True, False
        try:
            if self._controls.limits(v4l2.TRIGGER_MODE):
                self._controls.set(v4l2.TRIGGER_MODE, 0)
        except DeviceError as error:
            _log.warning("while closing: %s", error)
        finally:
            self._capture.close()
            self._controls.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None, /
    ) -> None:
        self.close()

    def _configure(self) -> None:
        """Everything that stays as it is: no automatism, gain, trigger mode."""
        controls, settings = self._controls, self._settings
        for automatism in (v4l2.AUTO_SHUTTER, v4l2.GAIN_AUTO):
            if controls.limits(automatism):
                controls.set(automatism, 0)
        if controls.limits(v4l2.STANDARD_AUTO_EXPOSURE):
            controls.set(v4l2.STANDARD_AUTO_EXPOSURE, v4l2.STANDARD_MANUAL)
        self._exposure_control, self._exposure_unit_us = v4l2.EXPOSURE_US, 1
        limits = controls.limits(v4l2.EXPOSURE_US)
        if limits is None:
            self._exposure_control, self._exposure_unit_us = v4l2.STANDARD_EXPOSURE_100_US, 100
            limits = controls.limits(v4l2.STANDARD_EXPOSURE_100_US)
        if limits is None:
            raise InputError(f"{self._name} has no control of its exposure time: set up the camera that the rig needs.")
        device_us = limits[0] * self._exposure_unit_us, limits[1] * self._exposure_unit_us
        self._exposure_limits_us = joint_limits_us(self._section, device_us, self._name)
        now_us = controls.get(self._exposure_control) * self._exposure_unit_us
        self.exposure_us = float(np.clip(now_us, *self._exposure_limits_us))
        self._set_gain(settings.gain_db)
        self._triggered = all(controls.limits(name) for name in (v4l2.TRIGGER_MODE, v4l2.SOFTWARE_TRIGGER))
        if self._triggered:
            controls.set(v4l2.TRIGGER_MODE, 1)
        else:
            _log.warning("%s has no software trigger: it runs freely, and each frame takes longer", self._name)

    def _set_gain(self, gain_db: float) -> None:
        limits = self._controls.limits(v4l2.GAIN_CENTIBEL)
        self._gain_db = 0.0
        if limits is not None:
            check_within(gain_db, (limits[0] / 100, limits[1] / 100), "gain", "dB")
            self._controls.set(v4l2.GAIN_CENTIBEL, round(gain_db * 100))
            self._gain_db = self._controls.get(v4l2.GAIN_CENTIBEL) / 100
        elif gain_db != 0:
            raise InputError(f"{self._name} has no gain in dB: set uvc.gain_db = 0, and its gain by v4l2-ctl.")

    def _fresh_image(self, asked_s: float, command: str) -> np.ndarray:
        exposure_s = self._exposure_us / 1e6
        # Without a trigger an exposure may have begun before; only the end of what came before can be told.
        earliest_s = asked_s if self._triggered else asked_s + exposure_s + self._settings.readout_s
        timeout_s = exposure_s + self._settings.frame_timeout_s + (earliest_s - asked_s)
        while (left_s := asked_s + timeout_s - time.monotonic()) > 0:
            frame = self._capture.read(left_s)
            if frame is None:
                break
            self._check(frame, command)
            if math.isfinite(frame.time_s) and frame.time_s >= earliest_s:
                return np.array(frame.image)
            _log.debug("%s: a frame from before it was asked for is passed over", self._name)
        raise TimedOut(self._name, command, timeout_s, _REMEDY, "the frame")

    def _check(self, frame: CapturedFrame, command: str) -> None:
        image, wanted = frame.image, np.dtype(np.uint8 if self._section.bits == 8 else np.uint16)
        if image.shape != self.shape or image.dtype != wanted:
            meaning = f"{image.dtype} of shape {image.shape} instead of {wanted} of shape {self.shape}"
            raise Fault(self._name, command, "not the frame that was set", meaning, _REMEDY)
        ahead_s = frame.time_s - time.monotonic()
        if ahead_s > 0:
            meaning = f"its time is {ahead_s:.3g} s ahead: what is fresh cannot be told"
            raise Fault(self._name, command, "another clock", meaning, "let the kernel's driver use CLOCK_MONOTONIC")
