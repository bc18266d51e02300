"""A client of the emulated camera that shares nothing with the driver: Aravis' own one-shot acquisition.

    python aravis_client.py LIBRARY ADDRESS FRAMES EXPOSURE_US

prints a JSON object: Aravis' version, the exposure that the camera reports, and SHA-256 and number of each frame.
"""

import ctypes
import hashlib
import json
import sys
from ctypes import byref, c_char_p, c_double, c_int, c_size_t, c_uint32, c_uint64, c_void_p

path, address, frames, exposure_us = sys.argv[1:]
library = ctypes.CDLL(path)


def call(name, result, kinds, *arguments):
    function = getattr(library, name)
    function.restype, function.argtypes = result, kinds
    return function(*arguments)


def ask(name, result, kinds, *arguments):
    error = c_void_p()
    value = call(name, result, (*kinds, c_void_p), *arguments, byref(error))
    if error:
        sys.exit(f"{name}: {ctypes.cast(error.value + 8, ctypes.POINTER(c_char_p))[0].decode()}")
    return value


camera = ask("arv_camera_new", c_void_p, (c_char_p,), address.encode())
ask("arv_camera_set_exposure_time", None, (c_void_p, c_double), camera, float(exposure_us))
ask("arv_camera_set_trigger", None, (c_void_p, c_char_p), camera, b"Software")
stream = ask("arv_camera_create_stream", c_void_p, (c_void_p, c_void_p, c_void_p), camera, None, None)
payload = ask("arv_camera_get_payload", c_uint32, (c_void_p,), camera)
for _ in range(3):
    buffer = call("arv_buffer_new_allocate", c_void_p, (c_size_t,), payload)
    call("arv_stream_push_buffer", None, (c_void_p, c_void_p), stream, buffer)
ask("arv_camera_start_acquisition", None, (c_void_p,), camera)
seen = []
for _ in range(int(frames)):
    ask("arv_camera_software_trigger", None, (c_void_p,), camera)
    number = 0
    while number == 0:  # GigE Vision's number of test packets, for which Aravis 0.8.26 hands out an empty buffer
        buffer = call("arv_stream_timeout_pop_buffer", c_void_p, (c_void_p, c_uint64), stream, 60_000_000)
        if not buffer:
            sys.exit("no frame came")
        number = call("arv_buffer_get_frame_id", c_uint64, (c_void_p,), buffer)
    status = call("arv_buffer_get_status", c_int, (c_void_p,), buffer)
    size = c_size_t()
    data = call("arv_buffer_get_data", c_void_p, (c_void_p, c_void_p), buffer, byref(size))
    seen.append([status, number, hashlib.sha256(ctypes.string_at(data, size.value)).hexdigest()])
    call("arv_stream_push_buffer", None, (c_void_p, c_void_p), stream, buffer)
extra = call("arv_stream_timeout_pop_buffer", c_void_p, (c_void_p, c_uint64), stream, 200_000)
ask("arv_camera_stop_acquisition", None, (c_void_p,), camera)
version = [call(f"arv_get_{part}_version", c_int, ()) for part in ("major", "minor", "micro")]
taken = ask("arv_camera_get_exposure_time", c_double, (c_void_p,), camera)
call("g_object_unref", None, (c_void_p,), stream)
call("g_object_unref", None, (c_void_p,), camera)
print(json.dumps({"version": version, "exposure_us": taken, "frames": seen, "extra": bool(extra)}))
