"""Frames of a video device as OpenCV takes them from Video4Linux, each with the kernel's own time."""

from dataclasses import dataclass

import cv2
import numpy as np

from .device_errors import ConnectionLost
from .errors import InputError

_FORMATS = {8: "GREY", 16: "Y16 "}


@dataclass(frozen=True)
class CapturedFrame:
    """A frame as it came.

    Parameters
    ----------
    image : (rows, cols) uint8 or uint16
    time_s : float
        By the clock of ``time.monotonic()``: when the kernel saw its first bytes, or, where the camera sends its own
        clock, when its exposure began.
    """

    image: np.ndarray
    time_s: float


class V4l2Capture:
    """A device file that streams.

    Parameters
    ----------
    path : str
    shape : (rows, cols)
    bits : int
        8 or 16 bits of grey.

    Raises
    ------
    ConnectionLost
        When the device cannot be opened for streaming.
    InputError
        When it does not offer frames of this size and format.
    """

    def __init__(self, path: str, shape: tuple[int, int], bits: int):
        if bits not in _FORMATS:
            raise InputError(f"a camera cannot send frames of camera.bits = {bits}: set 8 or 16.")
        fourcc = cv2.VideoWriter.fourcc(*_FORMATS[bits])
        wanted = {
            cv2.CAP_PROP_FOURCC: fourcc,
            cv2.CAP_PROP_FRAME_HEIGHT: shape[0],
            cv2.CAP_PROP_FRAME_WIDTH: shape[1],
            cv2.CAP_PROP_CONVERT_RGB: 0,
        }
        self._capture = cv2.VideoCapture(path, cv2.CAP_V4L2, [value for item in wanted.items() for value in item])
        if not self._capture.isOpened():
            remedy = "see that the camera is plugged in and that no other program has it"
            raise ConnectionLost(f"camera at {path}", "open for streaming", "it cannot be opened", remedy)
        taken = {name: round(self._capture.get(name)) for name in wanted}
        if taken != wanted:
            self._capture.release()
            raise InputError(
                f"camera at {path} does not offer frames of {shape[1]} x {shape[0]} in {_FORMATS[bits].strip()}: set "
                'camera.cols, camera.rows and camera.bits to what "v4l2-ctl --list-formats-ext" lists.'
            )

    def read(self, timeout_s: float) -> CapturedFrame | None:
        """The next frame of the queue; None when none comes within ``timeout_s``."""
        ready, _ = cv2.VideoCapture.waitAny([self._capture], timeoutNs=max(1, round(timeout_s * 1e9)))
        if not ready:
            return None
        taken, image = self._capture.retrieve()
        return CapturedFrame(image, self._capture.get(cv2.CAP_PROP_POS_MSEC) / 1000) if taken else None

    def close(self) -> None:
        self._capture.release()
