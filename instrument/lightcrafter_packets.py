"""The packets that a TI DLP LightCrafter (DM365 firmware 4 and later) exchanges over TCP.

======  ====  =================================================================
offset  size  field
======  ====  =================================================================
0       1     type, see ``PacketType``
1       2     command, CMD1 before CMD2
3       1     which part of a longer payload this is, see ``Part``
4       2     length n of the payload, low byte first
6       n     payload
6 + n   1     sum of all bytes before it, modulo 256
======  ====  =================================================================

A request is answered by one reply before the next is sent. A payload beyond 65535 bytes goes in several requests, each
with a checksum and a reply of its own.
"""

import struct
from dataclasses import dataclass
from enum import IntEnum

HEADER_BYTES = 6
MAX_PAYLOAD = 65535
MAX_PACKET = HEADER_BYTES + MAX_PAYLOAD + 1

_HEADER = struct.Struct("<BBBBH")


class PacketType(IntEnum):
    """What a packet is. A reply's type is the request's plus one, unless the device is busy or finds an error."""

    BUSY = 0
    ERROR = 1
    WRITE = 2
    WRITE_REPLY = 3
    READ = 4
    READ_REPLY = 5


class Part(IntEnum):
    """Which part of a payload a packet carries."""

    WHOLE = 0
    FIRST = 1
    MIDDLE = 2
    LAST = 3


@dataclass(frozen=True)
class Packet:
    """One packet.

    Parameters
    ----------
    type : int
        A ``PacketType``; any byte in a packet that was received damaged.
    command : int
        CMD1 in the high byte, CMD2 in the low one.
    payload : bytes
        At most ``MAX_PAYLOAD`` bytes.
    part : int
        A ``Part``; any byte in a packet that was received damaged.
    """

    type: int
    command: int
    payload: bytes = b""
    part: int = Part.WHOLE


class DamagedPacket(Exception):
    """A packet that was received to its end and cannot be used.

    ``packet`` is what it says; the bytes after it can be read on.
    """

    def __init__(self, packet: Packet):
        super().__init__(packet)
        self.packet = packet


class WrongChecksum(DamagedPacket):
    """Its last byte is not the sum of the others."""


class WrongFormat(DamagedPacket):
    """Its sum is right, but there is no such type or part."""


def encode_packet(packet: Packet) -> bytes:
    """The bytes of a packet. Raises ValueError for a payload that is too long."""
    if len(packet.payload) > MAX_PAYLOAD:
        raise ValueError(f"a packet carries at most {MAX_PAYLOAD} bytes, not {len(packet.payload)}")
    high, low = divmod(packet.command, 256)
    body = _HEADER.pack(packet.type, high, low, packet.part, len(packet.payload)) + packet.payload
    return body + bytes([checksum(body)])


def checksum(body: bytes) -> int:
    """Sum of all bytes modulo 256."""
    return sum(body) & 0xFF


def split(packet_type: PacketType, command: int, payload: bytes, size: int = MAX_PAYLOAD) -> list[Packet]:
    """The packets that carry a payload of any length, at most ``size`` bytes in each."""
    if len(payload) <= size:
        return [Packet(packet_type, command, payload)]
    chunks = [payload[start : start + size] for start in range(0, len(payload), size)]
    parts = [Part.FIRST, *[Part.MIDDLE] * (len(chunks) - 2), Part.LAST]
    return [Packet(packet_type, command, chunk, part) for chunk, part in zip(chunks, parts, strict=True)]


class PacketReader:
    """Cuts a stream of bytes into packets.

    There is no mark at which a packet begins: after bytes that were no packet, a reader waits for as many as the length
    in them says, at most ``MAX_PACKET``. It never holds more than twice that.
    """

    def __init__(self) -> None:
        self._bytes = bytearray()

    def __len__(self) -> int:
        """Bytes that are waiting."""
        return len(self._bytes)

    def feed(self, received: bytes) -> None:
        """Append at most ``MAX_PACKET`` bytes to what waits; packets are to be taken before more is fed.

        Raises ValueError, and appends nothing, where more than ``2 * MAX_PACKET`` bytes would wait.
        """
        if len(self._bytes) + len(received) > 2 * MAX_PACKET:
            raise ValueError("take the packets that were received before more bytes are fed")
        self._bytes += received

    def take(self) -> Packet | None:
        """The next packet; None while it is not complete.

        Raises
        ------
        WrongChecksum, WrongFormat
            For a packet that is complete and damaged. It is consumed: the next call goes on behind it.
        """
        if len(self._bytes) < HEADER_BYTES:
            return None
        packet_type, high, low, part, length = _HEADER.unpack_from(self._bytes)
        end = HEADER_BYTES + length
        if len(self._bytes) <= end:
            return None
        body, expected = bytes(self._bytes[:end]), self._bytes[end]
        del self._bytes[: end + 1]
        packet = Packet(packet_type, high << 8 | low, body[HEADER_BYTES:], part)
        if checksum(body) != expected:
            raise WrongChecksum(packet)
        if packet_type > PacketType.READ_REPLY or part > Part.LAST:
            raise WrongFormat(packet)
        return packet
