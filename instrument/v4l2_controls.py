"""Controls of a video device by Video4Linux ioctls: the standard's and those of a vendor's UVC extension.

The vendor's ids are those that The Imaging Source's own drivers map for its cameras of USB product id 84xx, such as the
DMK 23U445. The kernel knows them only after that mapping has been loaded, as tiscamera does with its
``uvc-extensions/usb23.json``.
"""

import errno
import fcntl
import os
import struct
from pathlib import Path

from .device_errors import ConnectionLost, DeviceError, Rejected
from .triggered_camera import CameraIdentity

EXPOSURE_US = 0x199E201
AUTO_SHUTTER = 0x199E202
GAIN_CENTIBEL = 0x199E204  # hundredths of a decibel
GAIN_AUTO = 0x199E205
TRIGGER_MODE = 0x199E208
SOFTWARE_TRIGGER = 0x199E209

STANDARD_AUTO_EXPOSURE = 0x9A0901
STANDARD_MANUAL = 1
STANDARD_EXPOSURE_100_US = 0x9A0902

_QUERY_CAPABILITIES = 0x80685600
_QUERY_CONTROL = 0xC0445624
_GET_CONTROL = 0xC008561B
_SET_CONTROL = 0xC008561C
_CONTROL = struct.Struct("=Ii")  # struct v4l2_control: id, value
_QUERY = struct.Struct("=II32siiiiI8x")  # struct v4l2_queryctrl: id, type, name, minimum, maximum, step, default, flags
_DISABLED = 0x0001
_UNPLUGGED = (errno.ENODEV, errno.ENXIO, errno.EBADF)
_RECONNECT = "plug the camera in again and run again"


class V4l2Controls:
    """The controls of one device file.

    Parameters
    ----------
    path : str
        ``/dev/video0``, better ``/dev/v4l/by-id/...``.

    Raises
    ------
    ConnectionLost
        When there is no such device, or it may not be opened.
    """

    def __init__(self, path: str):
        self._path, self._name = path, f"camera at {path}"
        try:
            self._file = os.open(path, os.O_RDWR | os.O_NONBLOCK)
        except OSError as error:
            remedy = "see that the camera is plugged in and that your account is in the group video"
            raise ConnectionLost(self._name, "open", str(error.strerror), remedy) from None

    def identity(self) -> CameraIdentity:
        """Vendor, model, serial and firmware, from what USB says of the device where it is a USB device."""
        answer = bytearray(104)  # struct v4l2_capability
        self._ioctl(_QUERY_CAPABILITIES, answer, "query capabilities")
        usb = Path("/sys/class/video4linux", Path(os.path.realpath(self._path)).name, "device").resolve().parent
        card = bytes(answer[16:48]).split(b"\0")[0].decode(errors="replace")
        return CameraIdentity(
            vendor=_text(usb / "manufacturer"),
            model=_text(usb / "product") or card,
            serial=_text(usb / "serial"),
            firmware=_text(usb / "bcdDevice"),
        )

    def limits(self, control: int) -> tuple[int, int] | None:
        """Least and greatest value of a control; None where the device does not have it."""
        query = bytearray(_QUERY.pack(control, 0, b"", 0, 0, 0, 0, 0))
        try:
            self._ioctl(_QUERY_CONTROL, query, f"query control {control:#x}")
        except Rejected:
            return None
        _, _, _, low, high, _, _, flags = _QUERY.unpack(query)
        return None if flags & _DISABLED else (low, high)

    def get(self, control: int) -> int:
        """Value of a control."""
        value = bytearray(_CONTROL.pack(control, 0))
        self._ioctl(_GET_CONTROL, value, f"get control {control:#x}")
        return _CONTROL.unpack(value)[1]

    def set(self, control: int, value: int) -> None:
        """Set a control; of a button any value presses it."""
        self._ioctl(_SET_CONTROL, bytearray(_CONTROL.pack(control, value)), f"set control {control:#x} to {value}")

    def close(self) -> None:
        if self._file >= 0:
            os.close(self._file)
            self._file = -1

    def _ioctl(self, request: int, data: bytearray, command: str) -> None:
        try:
            fcntl.ioctl(self._file, request, data)
        except OSError as error:
            raise self._typed(error, command) from None

    def _typed(self, error: OSError, command: str) -> DeviceError:
        if error.errno in _UNPLUGGED:
            return ConnectionLost(self._name, command, str(error.strerror), _RECONNECT)
        code = errno.errorcode.get(error.errno or 0, str(error.errno))
        return Rejected(self._name, command, code, str(error.strerror), "see that no other program has the camera")


def _text(path: Path) -> str:
    try:
        return path.read_text().strip()
    except OSError:
        return ""
