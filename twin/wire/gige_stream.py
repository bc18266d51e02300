"""Frames on the wire as GigE Vision streams them (GVSP), and what can go wrong with one."""

import random
import struct
from dataclasses import dataclass
from typing import Literal

IP_UDP_BYTES = 28
"""Headers around a packet, which the size that a client sets includes."""

_HEADER_BYTES = 8
_LEADER, _TRAILER, _PAYLOAD = 1, 2, 3
_IMAGE = 1
_UNAVAILABLE = 0x800C


@dataclass(frozen=True)
class FrameFault:
    """What goes wrong with one frame.

    Parameters
    ----------
    kind : str
        ``"late"``: it leaves ``delay_s`` after it should; ``"lost"``: it never does, though it is counted;
        ``"sent_twice"``: with the same block id; ``"untriggered"``: another one of the same picture follows that nobody
        asked for; ``"number_skipped"``: its block id is one too high, as after a frame that was lost on the way;
        ``"packets_lost"``: ``share`` of its packets do not arrive at first, and never do if ``for_good``.
    """

    kind: Literal["late", "lost", "sent_twice", "untriggered", "number_skipped", "packets_lost"]
    delay_s: float = 0.0
    share: float = 0.0
    for_good: bool = False


@dataclass(frozen=True)
class SentFrame:
    """A frame as it went to ``destination``, kept for packets that are asked for again.

    Packets whose number is among ``unavailable`` are answered for by an empty one that says so.
    """

    block: int
    packets: tuple[bytes, ...]
    destination: tuple[str, int]
    unavailable: frozenset[int] = frozenset()

    def packet(self, number: int) -> bytes:
        packet = self.packets[number]
        return struct.pack(">H", _UNAVAILABLE) + packet[2:_HEADER_BYTES] if number in self.unavailable else packet


def image_packets(
    block: int, time_ns: int, region: tuple[slice, slice], pixel_code: int, pixels: bytes, packet_bytes: int
) -> tuple[bytes, ...]:
    """Leader, payload and trailer of one image.

    Parameters
    ----------
    block : int
        The frame's number, 1 to 65535.
    time_ns : int
        When it was exposed, by the camera's clock.
    region : (rows, cols)
        Which part of the sensor it shows.
    pixel_code : int
        Its pixel format by the standard.
    pixels : bytes
    packet_bytes : int
        The greatest size of a packet.
    """
    rows, cols = region
    room = packet_bytes - _HEADER_BYTES
    size = struct.pack(">IIII", cols.stop - cols.start, rows.stop - rows.start, cols.start, rows.start)
    parts = [
        (_LEADER, struct.pack(">HHQI", 0, _IMAGE, time_ns, pixel_code) + size + bytes(4)),
        *((_PAYLOAD, pixels[start : start + room]) for start in range(0, len(pixels), room)),
        (_TRAILER, struct.pack(">HHI", 0, _IMAGE, rows.stop - rows.start)),
    ]
    return tuple(struct.pack(">HHI", 0, block, kind << 24 | number) + data for number, (kind, data) in enumerate(parts))


def some_payload(packets: tuple[bytes, ...], share: float, seed: int) -> frozenset[int]:
    """Numbers of a share of the packets between leader and trailer, at least one."""
    payload = range(1, len(packets) - 1)
    return frozenset(random.Random(seed).sample(payload, max(1, round(share * len(payload)))))
