"""Requests to a LightCrafter over TCP, one after the other, and what can go wrong with their replies."""

import logging
import socket
import time

from .device_errors import BadReply, ConnectionLost, Rejected, TimedOut
from .lightcrafter_commands import Command, ErrorCode
from .lightcrafter_packets import (
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

BUSY_PAUSE_S = 0.05  # before a busy device is asked again

_WIRE = logging.getLogger(f"{__package__}.lightcrafter.wire")
_LOGGED = 48  # bytes of a packet; patterns are long
_MEANINGS = {code.value: code.words for code in ErrorCode}
_REMEDY = "see that the projector is dark, check its power and network, and run again"
_REJECTED = "see that the projector's firmware is DM365 4.0 or later, power-cycle it, and run again"


class Link:
    """A connection to a LightCrafter.

    It is closed by whatever goes wrong within an exchange, an interrupt included: a reply that is still under way could
    not be told from the next one. Every wait ends.

    Parameters
    ----------
    host, port : str, int
    timeout_s : float
        How long a connection, or one reply, may take.
    busy_s : float
        How long a device that says it is busy is asked again.
    """

    def __init__(self, host: str, port: int, timeout_s: float, busy_s: float) -> None:
        self.device = f"projector at {host}:{port}"
        self._address = (host, port)
        self._timeout_s, self._busy_s = timeout_s, busy_s
        self._socket: socket.socket | None = None
        self._reader = PacketReader()

    @property
    def is_open(self) -> bool:
        return self._socket is not None

    def open(self) -> None:
        """Connect.

        Raises
        ------
        TimedOut, ConnectionLost
            When nobody answers at the address.
        """
        self.close()
        try:
            self._socket = socket.create_connection(self._address, self._timeout_s)
        except TimeoutError:
            raise TimedOut(self.device, "connect", self._timeout_s, _REMEDY, "a connection") from None
        except OSError as error:
            raise ConnectionLost(self.device, "connect", _reason(error), _REMEDY) from None
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._reader = PacketReader()
        _WIRE.debug("%s: connected", self.device)

    def close(self) -> None:
        """Disconnect, if connected."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None
            _WIRE.debug("%s: disconnected", self.device)

    def write(self, command: Command, payload: bytes = b"") -> None:
        """Send a command, in several packets where its payload is long.

        Raises
        ------
        DeviceError
            ``Rejected``, ``TimedOut``, ``BadReply`` or ``ConnectionLost``. After all but the first the link is closed.
        """
        for packet in split(PacketType.WRITE, command, payload):
            self._exchange(packet)

    def read(self, command: Command, payload: bytes = b"", size: int | None = None) -> bytes:
        """What the device answers to a question, ``size`` bytes if that is given. Raises as ``write`` does."""
        reply = self._exchange(Packet(PacketType.READ, command, payload))
        if size is not None and len(reply.payload) != size:
            self.close()
            raise self._bad(command, reply, f"{len(reply.payload)} bytes of payload instead of {size}")
        return reply.payload

    def _exchange(self, request: Packet) -> Packet:
        words = Command(request.command).words
        give_up = time.monotonic() + self._busy_s
        while True:
            try:
                reply = self._ask(request, words)
                reason = objection(request, reply)
                if reason:
                    raise self._bad(request.command, reply, reason)
            except BaseException:
                self.close()
                raise
            if reply.type != PacketType.BUSY:
                break
            if time.monotonic() + BUSY_PAUSE_S > give_up:
                raise TimedOut(self.device, words, self._busy_s, _REMEDY, "an idle projector")
            time.sleep(BUSY_PAUSE_S)
        if reply.type == PacketType.ERROR:
            code = reply.payload[0]
            raise Rejected(self.device, words, code, _MEANINGS.get(code, "undocumented"), _REJECTED)
        return reply

    def _ask(self, request: Packet, words: str) -> Packet:
        """Send and receive one packet, within ``timeout_s``."""
        if self._socket is None:
            raise ConnectionLost(self.device, words, "it was closed after an error", _REMEDY)
        deadline = time.monotonic() + self._timeout_s
        try:
            self._refuse_unsolicited(self._socket, request)
            data = encode_packet(request)
            _log(self.device, ">", data)
            self._socket.settimeout(self._timeout_s)
            self._socket.sendall(data)
            while True:
                try:
                    reply = self._reader.take()
                except DamagedPacket as damaged:
                    reason = "a wrong checksum" if isinstance(damaged, WrongChecksum) else "an unknown type"
                    raise self._bad(request.command, damaged.packet, reason) from None
                if reply is not None:
                    _log(self.device, "<", encode_packet(reply))
                    return reply
                left = deadline - time.monotonic()
                if left <= 0:
                    raise TimeoutError
                self._socket.settimeout(left)
                received = self._socket.recv(MAX_PACKET)
                if not received:
                    raise ConnectionLost(self.device, words, "closed by the projector", _REMEDY)
                self._reader.feed(received)
        except TimeoutError:
            raise TimedOut(self.device, words, self._timeout_s, _REMEDY) from None
        except OSError as error:
            raise ConnectionLost(self.device, words, _reason(error), _REMEDY) from None

    def _refuse_unsolicited(self, link: socket.socket, request: Packet) -> None:
        """Nothing may wait before a request is sent: it would be taken for the reply to it."""
        link.setblocking(False)
        try:
            waiting = link.recv(1, socket.MSG_PEEK)
        except BlockingIOError:
            waiting = b""
        else:
            if not waiting:
                words = Command(request.command).words
                raise ConnectionLost(self.device, words, "closed by the projector", _REMEDY)
        if waiting or len(self._reader):
            words = Command(request.command).words
            raise BadReply(self.device, words, waiting, "come before anything was asked", _REMEDY)

    def _bad(self, command: int, reply: Packet, reason: str) -> BadReply:
        return BadReply(self.device, Command(command).words, _raw(reply), reason, _REMEDY)


def objection(request: Packet, reply: Packet) -> str:
    """What is wrong with a reply, in words that follow "the reply has"; empty where it is one to the request."""
    if reply.command != request.command:
        return f"the command {reply.command:04x} instead of {request.command:04x}"
    if reply.type not in (request.type + 1, PacketType.BUSY, PacketType.ERROR):
        return f"the type {reply.type} instead of {request.type + 1}"
    if reply.part not in (Part.WHOLE, Part.FIRST):  # either is in the field
        return f"the part {reply.part} of a longer payload"
    if reply.type == PacketType.ERROR and not reply.payload:
        return "no error code"
    return ""


def _raw(packet: Packet) -> bytes:
    """The bytes of a packet but for the checksum, which may have been wrong."""
    return encode_packet(packet)[:-1]


def _reason(error: OSError) -> str:
    return (error.strerror or type(error).__name__).lower()


def _log(device: str, direction: str, data: bytes) -> None:
    if _WIRE.isEnabledFor(logging.DEBUG):
        rest = f" ... ({len(data)} bytes)" if len(data) > _LOGGED else ""
        _WIRE.debug("%s %s %s%s", device, direction, data[:_LOGGED].hex(" "), rest)
