"""Aravis, the library that speaks GenICam, by its C functions: nothing of it is needed until a camera is opened.

It is found as the operating system's own library or in the wheel ``aravis-python``, of which only that library is used.
"""

import ctypes
import ctypes.util
import importlib.util
import sys
from ctypes import POINTER, byref, c_char_p, c_double, c_int, c_size_t, c_uint, c_uint32, c_uint64, c_void_p
from functools import cache
from pathlib import Path
from typing import Any

from .errors import InputError

SUCCESS = 0
STATUS_NAMES = {
    1: "cleared",
    2: "timeout",
    3: "missing packets",
    4: "wrong packet id",
    5: "size mismatch",
    6: "filling",
    7: "aborted",
    8: "payload not supported",
}
"""What a buffer's status other than ``SUCCESS`` means."""

PIXEL_FORMATS = {"Mono8": 0x0108_0001, "Mono10": 0x0110_0003, "Mono12": 0x0110_0005, "Mono16": 0x0110_0007}
"""Codes of the standard for one or two whole bytes per pixel."""

CONTINUOUS, OFF = 0, 0
NO_PACKET_SOCKET = 1
REPLY_TIMEOUT_S = 6.0
"""How long Aravis waits for a GigE Vision camera's answer to one command.

It asks 6 times for 0.5 s each, and may have to wait as long for the answer to its own heartbeat before.
"""

_DEVICE_ERRORS = (
    "wrong feature",
    "feature not found",
    "not connected",
    "protocol error",
    "transfer error",
    "timeout",
    "not found",
    "invalid parameter",
    "description not found",
    "no stream channel",
    "not controller",
    "unknown",
    "not implemented",
    "invalid parameter",
    "invalid address",
    "write protect",
    "bad alignment",
    "access denied",
    "busy",
)

_WHEEL = {"darwin": "lib/libaravis-0.8.dylib", "win32": "bin/aravis-0.8-0.dll"}.get(
    sys.platform, "lib/libaravis-0.8.so"
)

_USB = "libusb-1.0.so.0"
_NEEDED = {
    "libglib-2.0.so.0": "libglib2.0-0",
    "libgobject-2.0.so.0": "libglib2.0-0",
    "libgio-2.0.so.0": "libglib2.0-0",
    "libxml2.so.2": "libxml2",
    _USB: "libusb-1.0-0",
}
"""Libraries that Aravis' wheel takes from the operating system, and the Debian packages that bring them."""

# Each: what it returns and takes. Functions that can fail take a place for their error besides, as the last.
_FALLIBLE: dict[str, tuple[Any, tuple[Any, ...]]] = {
    "arv_camera_new": (c_void_p, (c_char_p,)),
    "arv_camera_get_vendor_name": (c_char_p, (c_void_p,)),
    "arv_camera_get_model_name": (c_char_p, (c_void_p,)),
    "arv_camera_get_device_serial_number": (c_char_p, (c_void_p,)),
    "arv_camera_dup_available_pixel_formats_as_strings": (c_void_p, (c_void_p, POINTER(c_uint))),
    "arv_camera_set_pixel_format": (None, (c_void_p, c_uint32)),
    "arv_camera_set_region": (None, (c_void_p, c_int, c_int, c_int, c_int)),
    "arv_camera_get_region": (None, (c_void_p, *[POINTER(c_int)] * 4)),
    "arv_camera_set_trigger": (None, (c_void_p, c_char_p)),
    "arv_camera_software_trigger": (None, (c_void_p,)),
    "arv_camera_set_acquisition_mode": (None, (c_void_p, c_int)),
    "arv_camera_start_acquisition": (None, (c_void_p,)),
    "arv_camera_stop_acquisition": (None, (c_void_p,)),
    "arv_camera_is_exposure_auto_available": (c_int, (c_void_p,)),
    "arv_camera_set_exposure_time_auto": (None, (c_void_p, c_int)),
    "arv_camera_set_exposure_time": (None, (c_void_p, c_double)),
    "arv_camera_get_exposure_time": (c_double, (c_void_p,)),
    "arv_camera_get_exposure_time_bounds": (None, (c_void_p, POINTER(c_double), POINTER(c_double))),
    "arv_camera_is_gain_available": (c_int, (c_void_p,)),
    "arv_camera_is_gain_auto_available": (c_int, (c_void_p,)),
    "arv_camera_set_gain_auto": (None, (c_void_p, c_int)),
    "arv_camera_set_gain": (None, (c_void_p, c_double)),
    "arv_camera_get_gain": (c_double, (c_void_p,)),
    "arv_camera_get_gain_bounds": (None, (c_void_p, POINTER(c_double), POINTER(c_double))),
    "arv_camera_get_payload": (c_uint, (c_void_p,)),
    "arv_camera_create_stream": (c_void_p, (c_void_p, c_void_p, c_void_p)),
    "arv_device_is_feature_available": (c_int, (c_void_p, c_char_p)),
    "arv_device_execute_command": (None, (c_void_p, c_char_p)),
    "arv_device_get_string_feature_value": (c_char_p, (c_void_p, c_char_p)),
    "arv_device_get_integer_feature_value": (ctypes.c_int64, (c_void_p, c_char_p)),
    "arv_device_set_boolean_feature_value": (None, (c_void_p, c_char_p, c_int)),
    "arv_device_set_float_feature_value": (None, (c_void_p, c_char_p, c_double)),
    "arv_gv_device_get_timestamp_tick_frequency": (c_uint64, (c_void_p,)),
}
_SURE: dict[str, tuple[Any, tuple[Any, ...]]] = {
    "arv_camera_get_device": (c_void_p, (c_void_p,)),
    "arv_camera_is_gv_device": (c_int, (c_void_p,)),
    "arv_camera_gv_set_stream_options": (None, (c_void_p, c_int)),
    "arv_disable_interface": (None, (c_char_p,)),
    "arv_device_error_quark": (c_uint32, ()),
    "arv_buffer_new_allocate": (c_void_p, (c_size_t,)),
    "arv_buffer_get_status": (c_int, (c_void_p,)),
    "arv_buffer_get_frame_id": (c_uint64, (c_void_p,)),
    "arv_buffer_get_timestamp": (c_uint64, (c_void_p,)),
    "arv_buffer_get_image_width": (c_int, (c_void_p,)),
    "arv_buffer_get_image_height": (c_int, (c_void_p,)),
    "arv_buffer_get_image_pixel_format": (c_uint32, (c_void_p,)),
    "arv_buffer_get_image_data": (c_void_p, (c_void_p, POINTER(c_size_t))),
    "arv_stream_push_buffer": (None, (c_void_p, c_void_p)),
    "arv_stream_timeout_pop_buffer": (c_void_p, (c_void_p, c_uint64)),
    "g_object_unref": (None, (c_void_p,)),
    "g_free": (None, (c_void_p,)),
    "g_clear_error": (None, (c_void_p,)),
    "g_object_set_property": (None, (c_void_p, c_char_p, c_void_p)),
    "g_value_init": (c_void_p, (c_void_p, c_size_t)),
    "g_value_set_int": (None, (c_void_p, c_int)),
    "g_value_set_uint": (None, (c_void_p, c_uint)),
    "g_value_set_double": (None, (c_void_p, c_double)),
}
_G_TYPES = {"int": 6 << 2, "uint": 7 << 2, "double": 15 << 2}


class AravisError(Exception):
    """A function of Aravis failed: ``name`` says of which kind, in words, and ``message`` is its own."""

    def __init__(self, name: str, message: str):
        super().__init__(name, message)
        self.name, self.message = name, message


class _GError(ctypes.Structure):
    _fields_ = [("domain", c_uint32), ("code", c_int), ("message", c_char_p)]


class _GValue(ctypes.Structure):
    _fields_ = [("type", c_size_t), ("data", c_uint64 * 2)]


def find_libraries() -> tuple[str, ...]:
    """Aravis' libraries that are installed, the wheel's first: paths, or names that the linker knows."""
    wheel = _file_in_package("aravis", _WHEEL)
    system = ctypes.util.find_library("aravis-0.8")
    return tuple(library for library in (wheel, system) if library)


@cache
def find_usb_library() -> str | None:
    """The libusb of the wheel ``libusb-package``, where the operating system has none that can be loaded."""
    return None if _loads(_USB) else _file_in_package("libusb_package", "libusb-1.0.so")


@cache
def load() -> "Aravis":
    """The first Aravis that can be loaded, ready to be called.

    Raises
    ------
    InputError
        When none is installed, or none can be loaded; it names the libraries that are missing.
    """
    libraries = find_libraries()
    if not libraries:
        raise InputError(
            "GenICam cameras are reached through Aravis, which is not installed: "
            'run "apt-get install libaravis-0.8-0" (Debian, Ubuntu) or "pip install greenough[genicam]"'
        )
    usb = find_usb_library()
    if usb is not None:
        ctypes.CDLL(usb, mode=ctypes.RTLD_GLOBAL)  # the linker then takes it for the one that Aravis asks for
    reasons = []
    for library in libraries:
        try:
            return Aravis(ctypes.CDLL(library))
        except OSError as error:
            reasons.append(str(error))
    missing = [library for library in _NEEDED if not _loads(library)]
    if not missing:
        raise InputError(f"Aravis is installed but cannot be loaded: {'; '.join(reasons)}")
    packages = " ".join(dict.fromkeys(_NEEDED[library] for library in missing))
    raise InputError(
        f"Aravis is installed but cannot be loaded, because this machine lacks {', '.join(missing)}: "
        f'run "apt-get install {packages}" (Debian, Ubuntu)'
    )


def _file_in_package(package: str, path: str) -> str | None:
    """Path of a file in an installed package, which is not imported: its Python side may need more than the file."""
    spec = importlib.util.find_spec(package)
    if spec is None or not spec.submodule_search_locations:
        return None
    file = Path(spec.submodule_search_locations[0]) / path
    return str(file) if file.exists() else None


def _loads(library: str) -> bool:
    """Whether the linker finds a library of this name."""
    try:
        ctypes.CDLL(library)
    except OSError:
        return False
    return True


class Aravis:
    """The functions of one library; ``load`` makes it."""

    def __init__(self, library: ctypes.CDLL):
        self._library = library
        for name, (result, arguments) in _SURE.items():
            function = getattr(library, name)
            function.restype, function.argtypes = result, arguments
        for name, (result, arguments) in _FALLIBLE.items():
            function = getattr(library, name)
            function.restype, function.argtypes = result, (*arguments, POINTER(POINTER(_GError)))
        self._device_errors = library.arv_device_error_quark()

    def __call__(self, name: str, *arguments: Any) -> Any:
        """Call a function by its C name, without the place for its error; Python's strings are encoded.

        Raises
        ------
        AravisError
            When it reports an error.
        """
        function = getattr(self._library, name)
        arguments = tuple(value.encode() if isinstance(value, str) else value for value in arguments)
        if name in _SURE:
            return function(*arguments)
        error = POINTER(_GError)()
        result = function(*arguments, byref(error))
        if error:
            content = error.contents
            named = content.domain == self._device_errors and 0 <= content.code < len(_DEVICE_ERRORS)
            raised = AravisError(
                _DEVICE_ERRORS[content.code] if named else f"error {content.code}",
                (content.message or b"").decode(errors="replace"),
            )
            self._library.g_clear_error(byref(error))
            raise raised
        return result

    def text(self, name: str, *arguments: Any) -> str:
        """The same for a function that returns text that stays Aravis' own; empty where it returns none."""
        return (self(name, *arguments) or b"").decode(errors="replace")

    def limits(self, name: str, camera: int) -> tuple[float, float]:
        """The same for a function that gives a least and a greatest float."""
        low, high = c_double(), c_double()
        self(name, camera, byref(low), byref(high))
        return low.value, high.value

    def pixel_formats(self, camera: int) -> tuple[str, ...]:
        """Names of the pixel formats that a camera offers."""
        count = c_uint()
        names = self("arv_camera_dup_available_pixel_formats_as_strings", camera, byref(count))
        if not names:
            return ()
        found = tuple(name.decode() for name in ctypes.cast(names, POINTER(c_char_p))[: count.value] if name)
        self("g_free", names)
        return found

    def set_property(self, thing: int, name: str, kind: str, value: int | float) -> None:
        """Set a property of an object that is of the ``kind`` int, uint or double."""
        holder = _GValue()
        self("g_value_init", byref(holder), _G_TYPES[kind])
        self(f"g_value_set_{kind}", byref(holder), value)
        self("g_object_set_property", thing, name, byref(holder))
