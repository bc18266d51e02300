"""The emulated GigE Vision camera as the standard and clients of others' making see it."""

import hashlib
import json
import os
import random
import shutil
import socket
import struct
import subprocess
import sys
import time
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from emulated_gige import MODEL, emulated, need_aravis, picture

from greenough.instrument.aravis import find_libraries, find_usb_library
from greenough.instrument.errors import InputError
from greenough.twin.wire.gige_camera import PORT, GigeCamera, Trigger

pytestmark = pytest.mark.wire

CLIENT = ("127.0.0.1", 50_000)
OTHER = ("127.0.0.1", 50_001)
ACCESS_DENIED, INVALID_PARAMETER, INVALID_ADDRESS, WRITE_PROTECT, NOT_IMPLEMENTED = (
    0x8006,
    0x8002,
    0x8003,
    0x8004,
    0x8001,
)


def ask(camera: GigeCamera, command: int, body: bytes, number: int = 1, client=CLIENT) -> tuple[int, bytes]:
    """Status and payload of the answer to one command, whose header must be that of its acknowledge."""
    answer = camera.answer(struct.pack(">BBHHH", 0x42, 1, command, len(body), number) + body, client)
    status, acknowledge, length, echoed = struct.unpack_from(">HHHH", answer)
    assert (acknowledge, length, echoed) == (command + 1, len(answer) - 8, number)
    return status, answer[8:]


def write(camera: GigeCamera, address: int, value: int, number: int = 1, client=CLIENT) -> int:
    return ask(camera, 0x82, struct.pack(">II", address, value), number, client)[0]


def read(camera: GigeCamera, address: int) -> int:
    status, body = ask(camera, 0x80, struct.pack(">I", address))
    assert status == 0
    return int.from_bytes(body)


def await_failure(camera: GigeCamera) -> None:
    deadline_s = time.monotonic() + 60
    while camera.failure is None and time.monotonic() < deadline_s:
        time.sleep(0.01)


def off_wire() -> GigeCamera:
    """A camera that only ``answer`` speaks to."""
    return GigeCamera(MODEL, picture)


def test_golden_packets_of_the_standard():
    """Written by the standard's layout: key 42, flags, command, length, request id; then the acknowledge."""
    camera = off_wire()
    discovery = camera.answer(bytes.fromhex("42 01 0002 0000 0001"), CLIENT)
    assert discovery[:8] == bytes.fromhex("0000 0003 00f8 0001")
    assert discovery[8 + 0x48 :].startswith(b"Greenough\0")
    assert discovery[8 + 0xD8 :].startswith(b"SN-42\0")
    # READREG of the version: 1.2; WRITEREG of the control privilege, one register written; READMEM of the model's name
    assert camera.answer(bytes.fromhex("42 01 0080 0004 0002 00000000"), CLIENT) == bytes.fromhex(
        "0000 0081 0004 0002 00010002"
    )
    assert camera.answer(bytes.fromhex("42 01 0082 0008 0003 00000a00 00000002"), CLIENT) == bytes.fromhex(
        "0000 0083 0004 0003 0000 0001"
    )
    assert camera.answer(bytes.fromhex("42 01 0084 0008 0004 00000068 0000 0008"), CLIENT) == (
        bytes.fromhex("0000 0085 000c 0004 00000068") + b"Emulated"
    )


def test_only_one_client_has_control():
    camera = off_wire()
    assert write(camera, 0x4000, 32) == ACCESS_DENIED
    assert write(camera, 0xA00, 2) == 0
    assert write(camera, 0x4000, 32) == 0
    assert write(camera, 0xA00, 2, client=OTHER) == ACCESS_DENIED
    assert write(camera, 0x4000, 16, client=OTHER) == ACCESS_DENIED
    assert read(camera, 0x4000) == 32
    assert write(camera, 0xA00, 0) == 0
    assert write(camera, 0xA00, 2, client=OTHER) == 0


@pytest.mark.parametrize(
    ("address", "value", "status"),
    [
        (0x4000, 65, INVALID_PARAMETER),  # wider than the sensor
        (0x4004, 0, INVALID_PARAMETER),
        (0x4008, 1, INVALID_PARAMETER),  # off the sensor
        (0x4010, 0x0110_0007, INVALID_PARAMETER),  # Mono16
        (0xD18, 0xC0A8_0001, INVALID_PARAMETER),  # frames to somebody else
        (0x48, 0, WRITE_PROTECT),
        (0x7000, 0, INVALID_ADDRESS),
        (0xFFFF_FFFC, 0, INVALID_ADDRESS),
        (0x4001, 0, 0x8005),
    ],
)
def test_what_a_camera_cannot_do_is_refused_by_its_code(address, value, status):
    camera = off_wire()
    write(camera, 0xA00, 2)
    assert write(camera, address, value, number=2) == status


def test_unknown_commands_and_wrong_lengths_are_refused():
    camera = off_wire()
    assert ask(camera, 0x66, b"")[0] == NOT_IMPLEMENTED
    for command, body in ((0x80, b""), (0x80, b"abc"), (0x82, bytes(4)), (0x84, bytes(4)), (0x86, bytes(4))):
        assert ask(camera, command, body)[0] == 0x800E
    assert camera.answer(bytes.fromhex("42 01 0080 0008 0002 00000000"), CLIENT)[:2] == b"\x80\x0e"


def test_a_command_that_is_repeated_is_done_once():
    """A client that did not hear the answer sends the same request id again; a trigger must not expose twice."""
    camera = off_wire()
    for number, (address, value) in enumerate(((0xA00, 2), (0x4018, 1), (0x4014, 1)), start=1):
        assert write(camera, address, value, number) == 0
    for _ in range(3):
        assert write(camera, 0x401C, 1, number=9) == 0
    assert camera.triggers == 1
    assert write(camera, 0x401C, 1, number=10) == 0
    assert camera.triggers == 2


def test_nothing_is_exposed_without_acquisition_and_trigger_mode():
    camera = off_wire()
    write(camera, 0xA00, 2, 1)
    write(camera, 0x401C, 1, 2)
    write(camera, 0x4014, 1, 3)
    write(camera, 0x401C, 1, 4)
    assert camera.triggers == 0


@pytest.mark.slow
def test_random_and_mutated_packets_neither_crash_nor_grow_it():
    """100 000 datagrams: noise, and the packets above with bytes changed, cut off or appended."""
    rng = random.Random(5)
    camera = off_wire()
    bodies = {
        0x02: bytes(0),
        0x40: bytes(2) + struct.pack(">HII", 1, 0, 0xFF_FFFF),
        0x80: struct.pack(">II", 0, 0x4020),
        0x82: struct.pack(">IIII", 0xA00, 2, 0xD04, 0xC000_0240),
        0x84: struct.pack(">II", 0x8000, 512),
        0x86: struct.pack(">Id", 0x4020, 8333.0),
    }
    good = [struct.pack(">BBHHH", 0x42, 1, command, len(body), 7) + body for command, body in bodies.items()]
    good += [struct.pack(">BBHHHII", 0x42, 1, 0x82, 8, 7, address, 1) for address in (0x4014, 0x4018, 0x401C, 0xD00)]

    def batch(count: int) -> None:
        for _ in range(count):
            packet = bytearray(rng.choice(good) if rng.random() < 0.8 else rng.randbytes(rng.randrange(64)))
            for _ in range(rng.randrange(3)):
                if packet:
                    packet[rng.randrange(len(packet))] = rng.randrange(256)
            if rng.random() < 0.2:
                packet = packet[: rng.randrange(len(packet) + 1)] + rng.randbytes(rng.randrange(8))
            answer = camera.answer(bytes(packet), rng.choice((CLIENT, OTHER)))
            assert len(answer) <= 8 + 4 + 536
            assert len(answer) < 8 or answer[0] in (0x00, 0x80)

    camera._stream = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)  # where test packets leave
    try:
        batch(20_000)
        tracemalloc.start()
        batch(10_000)
        before = tracemalloc.get_traced_memory()[0]
        batch(70_000)
        assert tracemalloc.get_traced_memory()[0] < before + 100_000
    finally:
        tracemalloc.stop()
        camera._stream.close()
    assert ask(camera, 0x80, bytes(4), number=40_000) == (0, bytes.fromhex("00010002"))


def test_it_listens_on_loopback_only_and_says_where_it_cannot():
    with pytest.raises(InputError, match=r"reachable from other machines on 0\.0\.0\.0"):
        GigeCamera(MODEL, picture, "0.0.0.0")
    with emulated() as camera:
        with (
            pytest.raises(InputError, match=f"cannot listen on {camera.host} port {PORT}"),
            GigeCamera(MODEL, picture, camera.host),
        ):
            pass
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:
            client.bind(("127.0.0.1", 0))
            client.settimeout(30)
            client.sendto(bytes.fromhex("42 01 0080 0004 0002 00000000"), (camera.host, PORT))
            assert client.recv(100) == bytes.fromhex("0000 0081 0004 0002 00010002")


def test_a_source_that_fails_sends_nothing_and_is_kept():
    def broken(trigger):
        raise ArithmeticError("no picture")

    with emulated(source=broken) as camera:
        for number, (address, value) in enumerate(((0xA00, 2), (0x4018, 1), (0x4014, 1), (0x401C, 1)), start=1):
            assert write(camera, address, value, number) == 0
        await_failure(camera)
    assert isinstance(camera.failure, ArithmeticError)


@pytest.fixture(scope="module")
def peer():
    """Aravis' client in a process of its own: the version that the driver does not use, where two are installed."""
    need_aravis()
    library = find_libraries()[-1]

    def grab(address: str, frames: int, exposure_us: float) -> dict:
        script = Path(__file__).with_name("aravis_client.py")
        run = subprocess.run(
            [sys.executable, "-I", str(script), library, address, str(frames), str(exposure_us)],
            capture_output=True,
            text=True,
            timeout=200,
            env=os.environ | {"LD_PRELOAD": find_usb_library() or ""},
        )
        assert run.returncode == 0, run.stderr
        return json.loads(run.stdout)

    return grab


def test_an_independent_client_grabs_its_frames_bit_by_bit(peer):
    seen = []

    def source(trigger):
        seen.append(trigger)
        return picture(trigger)

    with emulated(source=source) as camera:
        got = peer(camera.host, 6, 12_345.5)
    expected = [hashlib.sha256(picture(Trigger(number, 0, 0)).tobytes()).hexdigest() for number in range(6)]
    assert got["frames"] == [[0, number + 1, digest] for number, digest in enumerate(expected)]
    assert got["exposure_us"] == 12_345.5
    assert {trigger.exposure_us for trigger in seen} == {12_345.5}
    assert not got["extra"]  # no frame without a trigger


def test_aravis_own_tool_reads_and_sets_it():
    tool = shutil.which("arv-tool-0.8")
    need_aravis(2 if tool is None else 1)  # it comes with the system's library
    assert tool, "the system's Aravis is without its tool: apt-get install aravis-tools-cli"
    with emulated() as camera:
        settings = ["DeviceSerialNumber", "Width=32", "ExposureTime=5000.5", "OffsetX=33"]
        run = subprocess.run(
            [tool, "-a", camera.host, "control", *settings], capture_output=True, text=True, timeout=200
        )
        assert camera.triggers == 0
    assert "DeviceSerialNumber = SN-42" in run.stdout
    assert "Width = 32 min:4 max:64" in run.stdout
    assert "ExposureTime = 5000.5 us min:20 max:2e+06" in run.stdout
    assert "OffsetX write error" in run.stdout


def test_pictures_of_another_kind_are_not_sent():
    with emulated(source=lambda trigger: np.zeros((3, 3))) as camera:
        for number, (address, value) in enumerate(((0xA00, 2), (0x4018, 1), (0x4014, 1), (0x401C, 1)), start=1):
            assert write(camera, address, value, number) == 0
        await_failure(camera)
    assert isinstance(camera.failure, ValueError)
