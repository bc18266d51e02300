"""The layers below the UVC driver, substituted: a camera with the vendor's controls that sees given pictures."""

import time
from collections import deque
from collections.abc import Callable

import numpy as np

from greenough.instrument import v4l2_controls
from greenough.instrument.triggered_camera import CameraIdentity
from greenough.instrument.v4l2_capture import CapturedFrame
from greenough.twin.wire.gige_camera import Trigger

LIMITS = {
    v4l2_controls.EXPOSURE_US: (20, 30_000_000),
    v4l2_controls.AUTO_SHUTTER: (0, 1),
    v4l2_controls.GAIN_CENTIBEL: (0, 3000),
    v4l2_controls.GAIN_AUTO: (0, 1),
    v4l2_controls.TRIGGER_MODE: (0, 1),
    v4l2_controls.SOFTWARE_TRIGGER: (0, 0),
}


class SubstitutedUvc:
    """Both layers, ``Capture`` and ``Controls``, in one: a frame per software trigger, there at once.

    Parameters
    ----------
    picture : callable of Trigger
    first : int
        Number of its first exposure.
    """

    def __init__(self, picture: Callable[[Trigger], np.ndarray], first: int):
        self._picture, self._next, self._acquisition = picture, first, first
        self._values = dict.fromkeys(LIMITS, 1)
        self._queue: deque[CapturedFrame] = deque()

    def read(self, timeout_s: float) -> CapturedFrame | None:
        if self._queue:
            return self._queue.popleft()
        self._acquisition = self._next  # nothing is under way: the driver arms
        return None

    def identity(self) -> CameraIdentity:
        return CameraIdentity("The Imaging Source", "DMK 23U445", "1234", "1.0")

    def limits(self, control: int) -> tuple[int, int] | None:
        return LIMITS.get(control)

    def get(self, control: int) -> int:
        return self._values[control]

    def set(self, control: int, value: int) -> None:
        self._values[control] = value
        if control == v4l2_controls.SOFTWARE_TRIGGER:
            exposure_us = float(self._values[v4l2_controls.EXPOSURE_US])
            image = self._picture(Trigger(self._next, exposure_us, 0.0, self._acquisition)).copy()
            self._next += 1
            self._queue.append(CapturedFrame(image, time.monotonic()))

    def close(self) -> None:
        self._queue.clear()
