"""An emulated LightCrafter on TCP: the real one's packets, byte for byte, and the ways in which a wire fails."""

import selectors
import socket
import struct
import threading
from collections.abc import Callable
from enum import Enum, auto
from typing import Self

from greenough.instrument.errors import InputError
from greenough.instrument.lightcrafter_commands import ErrorCode
from greenough.instrument.lightcrafter_packets import (
    MAX_PACKET,
    DamagedPacket,
    Packet,
    PacketReader,
    PacketType,
    Part,
    WrongChecksum,
    encode_packet,
    split,
)

from .lightcrafter_device import LONGEST_PAYLOAD, LightCrafterDevice, Refusal
from .loopback import check_loopback

MAX_CLIENTS = 4


class Fault(Enum):
    """What goes wrong with one request."""

    NONE = auto()
    BUSY = auto()  # answered as busy, not executed
    FAILED = auto()  # answered by an error, not executed
    SILENCE = auto()  # neither answered nor executed
    RESET = auto()  # the connection is reset, nothing executed
    WRONG_CHECKSUM = auto()  # executed, the reply's checksum is wrong
    TRUNCATED = auto()  # executed, the reply's last byte is missing
    TWICE = auto()  # executed, the reply is sent twice


Faults = Callable[[Packet], Fault]
"""Says of every request, in the order in which they come, what goes wrong with it."""


def at_request(number: int, fault: Fault, count: int = 1) -> Faults:
    """``fault`` for ``count`` requests from the one with this number, from 0, and none for the others."""
    seen = -1

    def faults(request: Packet) -> Fault:
        nonlocal seen
        seen += 1
        return fault if number <= seen < number + count else Fault.NONE

    return faults


class ResetByFault(Exception):
    """The connection is to be reset."""


class Dialogue:
    """What is said over one connection: bytes in, bytes out, never more than one reply ahead.

    It holds at most the bytes of two packets and of one pattern that is not complete.
    """

    def __init__(self, device: LightCrafterDevice, faults: Faults = lambda request: Fault.NONE) -> None:
        self._device = device
        self._faults = faults
        self._reader = PacketReader()
        self._partial: tuple[int, bytearray] | None = None  # command and payload so far

    @property
    def held_bytes(self) -> int:
        """How much waits for more."""
        return len(self._reader) + (len(self._partial[1]) if self._partial else 0)

    def hear(self, received: bytes) -> None:
        """Take at most ``MAX_PACKET`` bytes from the wire, when all that came before has been answered."""
        self._reader.feed(received)

    def say(self) -> bytes | None:
        """The bytes that answer the next request; None when there is none to be answered.

        Raises
        ------
        ResetByFault
        """
        try:
            request = self._reader.take()
        except DamagedPacket as damaged:
            code = ErrorCode.CHECKSUM if isinstance(damaged, WrongChecksum) else ErrorCode.PACKET_FORMAT
            return _error(damaged.packet, code)
        if request is None:
            return None
        fault = self._faults(request)
        match fault:
            case Fault.BUSY:
                return encode_packet(Packet(PacketType.BUSY, request.command))
            case Fault.FAILED:
                return _error(request, ErrorCode.FAILED)
            case Fault.SILENCE:
                return b""
            case Fault.RESET:
                raise ResetByFault
        reply = self._obey(request)
        match fault:
            case Fault.WRONG_CHECKSUM:
                return reply[:-1] + bytes([reply[-1] ^ 0xFF])
            case Fault.TRUNCATED:
                return reply[:-1]
            case Fault.TWICE:
                return 2 * reply
        return reply

    def _obey(self, request: Packet) -> bytes:
        try:
            if request.type == PacketType.READ and request.part == Part.WHOLE:
                answer = self._device.read(request.command, request.payload)
                return b"".join(map(encode_packet, split(PacketType.READ_REPLY, request.command, answer)))
            if request.type == PacketType.READ:
                raise Refusal(ErrorCode.CONTINUATION)
            if request.type != PacketType.WRITE:
                raise Refusal(ErrorCode.PACKET_FORMAT)
            payload = self._collect(request)
            if payload is not None:
                self._device.write(request.command, payload)
        except Refusal as refusal:
            self._partial = None
            return _error(request, refusal.code)
        return encode_packet(Packet(PacketType.WRITE_REPLY, request.command))

    def _collect(self, request: Packet) -> bytes | None:
        """The whole payload, once its last part has come."""
        if request.part in (Part.WHOLE, Part.FIRST):
            payload = bytearray(request.payload)
        elif self._partial is not None and self._partial[0] == request.command:
            payload = self._partial[1]
            payload += request.payload
        else:
            raise Refusal(ErrorCode.CONTINUATION)
        if len(payload) > LONGEST_PAYLOAD:
            raise Refusal(ErrorCode.PACKET_FORMAT)
        if request.part in (Part.FIRST, Part.MIDDLE):
            self._partial = request.command, payload
            return None
        self._partial = None
        return bytes(payload)


class LightCrafterServer:
    """Serves a device to at most ``MAX_CLIENTS`` connections, in a thread of its own, from ``with`` to its end.

    What is shown outlives a connection, as on the real device.

    Parameters
    ----------
    device : LightCrafterDevice
    host : str
        Address to listen on, of this machine alone.
    port : int
        0 for any that is free; see ``port``.
    faults : Faults
        What goes wrong; an attribute of the same name may be set at any time.
    allow_remote : bool
        Take another address than loopback.

    Raises
    ------
    InputError
        For an address that others can reach, unless ``allow_remote``, and on entering for one that is taken.
    """

    def __init__(
        self,
        device: LightCrafterDevice,
        host: str = "127.0.0.1",
        port: int = 0,
        faults: Faults = lambda request: Fault.NONE,
        allow_remote: bool = False,
    ) -> None:
        check_loopback(host, allow_remote)
        self.device = device
        self.faults = faults
        self._address = (host, port)
        self._clients: dict[socket.socket, tuple[Dialogue, bytes]] = {}  # and what is still to be sent

    @property
    def port(self) -> int:
        """The port that is listened on."""
        return self._listener.getsockname()[1]

    def __enter__(self) -> Self:
        try:
            self._listener = socket.create_server(self._address)
        except OSError as error:
            raise InputError(
                "the emulated LightCrafter cannot listen on {} port {} ({}): end what listens there, or give another "
                "port".format(*self._address, (error.strerror or "").lower())
            ) from None
        self._listener.setblocking(False)
        self._waker, self._woken = socket.socketpair()
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._listener, selectors.EVENT_READ)
        self._selector.register(self._woken, selectors.EVENT_READ)
        self._thread = threading.Thread(target=self._serve, name="emulated LightCrafter", daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *exc: object) -> None:
        self._waker.close()  # which is readable at the other end
        self._thread.join()

    def _serve(self) -> None:
        try:
            while True:
                for key, _ in self._selector.select():
                    if key.fileobj is self._woken:
                        return
                    if key.fileobj is self._listener:
                        self._accept()
                    elif isinstance(key.fileobj, socket.socket):
                        self._attend(key.fileobj)
        finally:
            for client in list(self._clients):
                self._drop(client)
            self._selector.close()
            self._listener.close()
            self._woken.close()

    def _accept(self) -> None:
        try:
            client, _ = self._listener.accept()
        except OSError:  # it is gone again
            return
        if len(self._clients) == MAX_CLIENTS:
            client.close()
            return
        client.setblocking(False)
        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._clients[client] = Dialogue(self.device, lambda request: self.faults(request)), b""
        self._selector.register(client, selectors.EVENT_READ)

    def _attend(self, client: socket.socket) -> None:
        """Send what is to be sent; then, and not before, read and answer."""
        dialogue, outgoing = self._clients[client]
        try:
            if not outgoing:
                received = client.recv(MAX_PACKET)
                if not received:
                    self._drop(client)
                    return
                dialogue.hear(received)
            while True:
                if outgoing:
                    outgoing = outgoing[client.send(outgoing) :]
                    if outgoing:
                        break
                reply = dialogue.say()
                if reply is None:
                    break
                outgoing = reply
        except BlockingIOError:  # from sending; it waits until the client reads
            pass
        except ResetByFault:
            client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
            self._drop(client)
            return
        except OSError:
            self._drop(client)
            return
        self._clients[client] = dialogue, outgoing
        self._selector.modify(client, selectors.EVENT_WRITE if outgoing else selectors.EVENT_READ)

    def _drop(self, client: socket.socket) -> None:
        self._selector.unregister(client)
        del self._clients[client]
        client.close()


def _error(request: Packet, code: ErrorCode) -> bytes:
    return encode_packet(Packet(PacketType.ERROR, request.command, bytes([code])))
