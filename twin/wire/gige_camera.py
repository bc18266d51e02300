"""A GigE Vision camera that is not there: it answers on loopback and its pictures come from a function.

Control (GVCP) and stream (GVSP) are those of GigE Vision 1.2 with 16-bit block ids. A software trigger takes the
settings of its moment, the picture is asked for in a thread of its own, so that the camera goes on answering while one
is rendered, and the frame goes to the client that has control. No frame leaves without a trigger. Frames and packets
can be spoiled on purpose, to see what a client makes of it.
"""

import logging
import queue
import socket
import struct
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from greenough.instrument.errors import InputError

from . import gige_registers as reg
from .gige_registers import CameraModel, Refused, Registers
from .gige_stream import IP_UDP_BYTES, FrameFault, SentFrame, image_packets, some_payload
from .loopback import check_loopback

PORT = 3956
"""Where clients of GigE Vision expect a camera; only its address is free."""

_COMMAND = 0x42
_DISCOVERY, _RESEND, _READ_REGISTERS, _WRITE_REGISTERS, _READ_MEMORY, _WRITE_MEMORY = 0x02, 0x40, 0x80, 0x82, 0x84, 0x86
_WANTS_ACKNOWLEDGE = 0x01
_NOT_IMPLEMENTED, _INVALID_HEADER = 0x8001, 0x800E
_MEMORY_MAX = 536  # bytes of memory in one packet

_FRAMES_KEPT = 4  # for packets that are asked for again
_TRIGGERS_WAITING = 8
_BURST, _PAUSE_S = 12, 2e-4  # packets at once: what a socket buffers by default, with room
_POLL_S = 0.05

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Trigger:
    """One exposure as it was asked for.

    Parameters
    ----------
    number : int
        Of the triggers since the camera was switched on, from 0.
    exposure_us, gain_db : float
        As they were set when the trigger came.
    first : int
        Number of the first trigger of the same acquisition.
    """

    number: int
    exposure_us: float
    gain_db: float
    first: int = 0


@dataclass(frozen=True)
class _Exposure:
    trigger: Trigger
    time_ns: int  # of the camera's clock
    region: tuple[slice, slice]


class GigeCamera:
    """An emulated camera; as a context manager it is on the network.

    Parameters
    ----------
    model : CameraModel
    picture : function
        Of a ``Trigger``: the whole sensor's picture, (rows, cols) uint8, or uint16 for a model of more bits. It is
        called once per trigger, in their order, in a thread of the camera.
    host : str
        A loopback address. Linux has millions of them, so that many cameras can stand side by side.
    allow_remote : bool
        Take any address.

    Raises
    ------
    InputError
        When ``host`` is not loopback, or another camera is there.
    """

    def __init__(
        self,
        model: CameraModel,
        picture: Callable[[Trigger], np.ndarray],
        host: str = "127.0.0.1",
        allow_remote: bool = False,
    ):
        check_loopback(host, allow_remote)
        self.host = host
        self.silent = False
        """While true, nothing is answered and nothing sent."""
        self.frame_faults: dict[int, FrameFault] = {}
        """By the number of the trigger."""
        self._model, self._picture = model, picture
        self._registers = Registers(model, socket.inet_aton("127.0.0.1" if host == "localhost" else host))
        self._controller: tuple[str, int] | None = None
        self._heard_s = 0.0
        self._streaming = False
        self._triggers = self._first_trigger = 0
        self._blocks = 0
        self._exposures: queue.Queue[_Exposure] = queue.Queue(_TRIGGERS_WAITING)
        self._sent: deque[SentFrame] = deque(maxlen=_FRAMES_KEPT)
        self._answered: tuple[tuple[tuple[str, int], bytes] | None, bytes] = None, b""
        self._handlers = {
            _DISCOVERY: self._discover,
            _RESEND: self._send_again,
            _READ_REGISTERS: self._read_registers,
            _WRITE_REGISTERS: self._write_registers,
            _READ_MEMORY: self._read_memory,
            _WRITE_MEMORY: self._write_memory,
        }
        self.failure: Exception | None = None
        """What the function of the pictures raised; the frame was not sent then."""
        self._closing = threading.Event()
        self._threads: list[threading.Thread] = []

    @property
    def triggers(self) -> int:
        """How many were taken since the camera was switched on."""
        return self._triggers

    @property
    def is_controlled(self) -> bool:
        """Whether a client has control, or is still taken to have it."""
        return self._controller is not None

    def __enter__(self) -> Self:
        self._control = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._stream = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._control.bind((self.host, PORT))
            self._stream.bind((self.host, 0))
        except OSError as error:
            self._control.close()
            self._stream.close()
            raise InputError(
                f"the emulated camera cannot listen on {self.host} port {PORT} ({error.strerror}): end what listens "
                "there, or give another loopback address, 127.0.0.2 for example."
            ) from None
        self._registers.set_u32(reg.STREAM_SOURCE_PORT, self._stream.getsockname()[1])
        self._control.settimeout(_POLL_S)
        for run, name in ((self._answer, "control"), (self._expose, "exposure")):
            thread = threading.Thread(target=run, name=f"emulated camera {self.host}, {name}", daemon=True)
            thread.start()
            self._threads.append(thread)
        return self

    def __exit__(self, *exc: object) -> None:
        self._closing.set()
        for thread in self._threads:
            thread.join()
        self._control.close()
        self._stream.close()

    def _answer(self) -> None:
        """The control thread."""
        while not self._closing.is_set():
            try:
                request, client = self._control.recvfrom(2048)
            except TimeoutError:
                request, client = b"", ("", 0)
            if self.silent:
                continue
            heartbeat_s = self._registers.u32(reg.HEARTBEAT_MS) / 1000
            if self._controller is not None and time.monotonic() - self._heard_s > heartbeat_s:
                _log.warning("the client %s:%d has gone without a word", *self._controller)
                self._release()
            answer = self.answer(request, client) if request else b""
            if answer:
                self._control.sendto(answer, client)

    def answer(self, request: bytes, client: tuple[str, int]) -> bytes:
        """What is sent back for one datagram from ``client``, a host and a port; nothing for what is no request."""
        if len(request) < 8 or request[0] != _COMMAND:
            return b""
        if client == self._controller:
            self._heard_s = time.monotonic()
        if self._answered[0] == (client, request):
            return self._answered[1]  # the client did not hear it: what it asked for is done already
        _, flags, command, length, number = struct.unpack_from(">BBHHH", request)
        body = request[8:]
        try:
            if length != len(body):
                raise Refused(_INVALID_HEADER)
            if command not in self._handlers:
                raise Refused(_NOT_IMPLEMENTED)
            status, reply = 0, self._handlers[command](body, client)
        except Refused as refused:
            status, reply = refused.status, b""
            _log.debug("%s: command %#x of %s is refused with %#x", self.host, command, client, status)
        if command == _RESEND or not flags & _WANTS_ACKNOWLEDGE:
            return b""
        answer = struct.pack(">HHHH", status, (command + 1) & 0xFFFF, len(reply), number) + reply
        self._answered = (client, request), answer
        return answer

    def _discover(self, body: bytes, client: tuple[str, int]) -> bytes:
        return self._registers.read(0, reg.DISCOVERY_BYTES)

    def _read_registers(self, body: bytes, client: tuple[str, int]) -> bytes:
        return b"".join(self._registers.read(address, 4) for (address,) in _records(body, ">I"))

    def _read_memory(self, body: bytes, client: tuple[str, int]) -> bytes:
        if len(body) != 8:
            raise Refused(_INVALID_HEADER)
        address, count = struct.unpack(">I2xH", body)
        if count > _MEMORY_MAX:
            raise Refused(reg.INVALID_PARAMETER)
        return body[:4] + self._registers.read(address, count)

    def _write_registers(self, body: bytes, client: tuple[str, int]) -> bytes:
        writes = _records(body, ">I4s")
        for address, value in writes:
            self._write(address, value, client)
        return struct.pack(">HH", 0, len(writes))

    def _write_memory(self, body: bytes, client: tuple[str, int]) -> bytes:
        if len(body) <= 4:
            raise Refused(_INVALID_HEADER)
        self._write(int.from_bytes(body[:4]), body[4:], client)
        return struct.pack(">HH", 0, len(body) - 4)

    def _send_again(self, body: bytes, client: tuple[str, int]) -> bytes:
        if len(body) < 12 or self._controller is None or client[0] != self._controller[0]:
            raise Refused(_INVALID_HEADER)  # the port may be another: clients ask from where they receive
        block, first, last = struct.unpack_from(">2xHII", body)
        frame = next((sent for sent in tuple(self._sent) if sent.block == block), None)
        if frame is not None:
            first, last = first & 0xFF_FFFF, min(last & 0xFF_FFFF, len(frame.packets) - 1)
            self._send(frame, range(first, last + 1))
        return b""

    def _write(self, address: int, data: bytes, client: tuple[str, int]) -> None:
        wants_control = address == reg.CONTROL_PRIVILEGE and self._controller is None
        if client != self._controller and not wants_control:
            raise Refused(reg.ACCESS_DENIED)
        self._registers.write(address, data, self._streaming, socket.inet_aton(client[0]))
        value = int.from_bytes(data)
        match address:
            case reg.CONTROL_PRIVILEGE:
                if value:
                    self._controller, self._heard_s = client, time.monotonic()
                else:
                    self._release()
            case reg.TIMESTAMP_CONTROL if value & 2:
                self._registers.set_u64(reg.TIMESTAMP_VALUE, time.monotonic_ns())
            case reg.PACKET_SIZE if value & reg.FIRE_TEST_PACKET:
                self._registers.set_u32(reg.PACKET_SIZE, value & ~reg.FIRE_TEST_PACKET)
                self._send_packet(bytes((value & 0xFFFF) - IP_UDP_BYTES), self._destination())
            case reg.ACQUISITION:
                self._streaming = bool(value)
                if value:
                    self._blocks, self._first_trigger = 0, self._triggers
                    self._sent.clear()  # numbers begin anew: packets of older frames must not be taken for new ones
            case reg.TRIGGER_SOFTWARE:
                self._take_trigger()

    def _release(self) -> None:
        self._controller = None
        self._streaming = False
        for address in (reg.CONTROL_PRIVILEGE, reg.STREAM_PORT, reg.STREAM_ADDRESS):
            self._registers.set_u32(address, 0)

    def _destination(self) -> tuple[str, int]:
        registers = self._registers
        return socket.inet_ntoa(registers.read(reg.STREAM_ADDRESS, 4)), registers.u32(reg.STREAM_PORT)

    def _take_trigger(self) -> None:
        if not (self._streaming and self._registers.u32(reg.TRIGGER_MODE)):
            return
        read = self._registers.u32
        top, left = read(reg.OFFSET_Y), read(reg.OFFSET_X)
        region = slice(top, top + read(reg.HEIGHT)), slice(left, left + read(reg.WIDTH))
        exposure_us, gain_db = self._registers.f64(reg.EXPOSURE_US), self._registers.f64(reg.GAIN_DB)
        trigger = Trigger(self._triggers, exposure_us, gain_db, self._first_trigger)
        try:
            self._exposures.put_nowait(_Exposure(trigger, time.monotonic_ns(), region))
        except queue.Full:
            raise Refused(reg.BUSY) from None
        self._triggers += 1

    def _expose(self) -> None:
        """The exposure thread."""
        while not self._closing.is_set():
            try:
                exposure = self._exposures.get(timeout=_POLL_S)
            except queue.Empty:
                continue
            try:
                picture = self._picture(exposure.trigger)
                wanted = np.dtype(np.uint8 if self._model.pixel_bytes == 1 else np.uint16)
                if picture.shape != self._model.shape or picture.dtype != wanted:
                    raise ValueError(f"it is {picture.dtype} {picture.shape}, not {wanted} {self._model.shape}")
            except Exception as failure:  # whatever it was, the camera stays there and says nothing, as a broken one
                _log.exception("%s: there is no picture for trigger %d", self.host, exposure.trigger.number)
                self.failure = failure
                continue
            self._deliver(exposure, picture[exposure.region])

    def _deliver(self, exposure: _Exposure, picture: np.ndarray) -> None:
        pixels = picture.astype(picture.dtype.newbyteorder("<")).tobytes()
        fault = self.frame_faults.get(exposure.trigger.number)
        kind = fault.kind if fault else None
        if fault and kind == "late":
            self._closing.wait(fault.delay_s)
        if kind == "number_skipped":
            self._blocks += 1
        frame = self._frame(exposure, pixels)
        everything = range(len(frame.packets))
        if kind == "lost" or self.silent or not self._streaming:
            return
        arriving = everything
        if fault and kind == "packets_lost":
            lost = some_payload(frame.packets, fault.share, seed=exposure.trigger.number)
            frame = replace(frame, unavailable=lost if fault.for_good else frozenset())
            arriving = [number for number in everything if number not in lost]
        self._sent.append(frame)
        self._send(frame, arriving)
        if kind == "sent_twice":
            self._send(frame, everything)
        if kind == "untriggered":
            self._send(self._frame(exposure, pixels), everything)

    def _frame(self, exposure: _Exposure, pixels: bytes) -> SentFrame:
        """The next block."""
        self._blocks = self._blocks % 0xFFFF + 1
        room = (self._registers.u32(reg.PACKET_SIZE) & 0xFFFF) - IP_UDP_BYTES
        code = reg.PIXEL_CODES[self._model.pixel_format]
        packets = image_packets(self._blocks, exposure.time_ns, exposure.region, code, pixels, room)
        return SentFrame(self._blocks, packets, self._destination())

    def _send(self, frame: SentFrame, numbers: Iterable[int]) -> None:
        for count, number in enumerate(numbers, start=1):
            self._send_packet(frame.packet(number), frame.destination)
            if count % _BURST == 0:
                time.sleep(_PAUSE_S)

    def _send_packet(self, packet: bytes, destination: tuple[str, int]) -> None:
        if destination[0] != "0.0.0.0" and destination[1]:  # where a client has said where
            self._stream.sendto(packet, destination)


def _records(body: bytes, layout: str) -> list[tuple]:
    """The whole body as records of one ``struct`` layout; Refused when there is none or one is cut off."""
    if not body or len(body) % struct.calcsize(layout):
        raise Refused(_INVALID_HEADER)
    return list(struct.iter_unpack(layout, body))
