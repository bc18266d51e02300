"""Zaber's ASCII protocol as a device reads and writes it.

It is written down a second time, without the driver's own functions, so that a mistake in these is not repeated.
"""

import re
from dataclasses import dataclass

_LONGEST = 128
_CHECKSUM = re.compile(rb":([0-9A-Fa-f]{2})")


@dataclass(frozen=True)
class Command:
    """What a host sent; ``words`` is empty where it asks for the status alone, ``checked`` where it had a checksum."""

    device: int
    axis: int
    message_id: int | None
    words: list[str]
    checked: bool


def parse_command(line: bytes) -> Command | None:
    """None where firmware ignores the line: no command in it, too long, not ASCII, or with a wrong checksum."""
    start = line.find(b"/")
    if start < 0 or len(line) - start > _LONGEST or not line.isascii():
        return None
    content, colon, digits = line[start + 1 :].partition(b":")
    if colon:
        mark = _CHECKSUM.fullmatch(colon + digits)
        if mark is None or (sum(content) + int(mark[1], 16)) % 256:
            return None
    words = content.decode("ascii").split()
    numbers = []
    while words and len(numbers) < 3 and words[0].isdecimal() and len(words[0]) <= 3:
        numbers.append(int(words.pop(0)))
    device, axis, message_id = [*numbers, *[None] * (3 - len(numbers))]
    return Command(device or 0, axis or 0, message_id, words, bool(colon))


def pieces(data: str, room: int) -> list[str]:
    """``data`` in pieces of at most ``room`` characters where it can be cut between words."""
    pieces = [""]
    for word in data.split(" "):
        if pieces[-1] and len(pieces[-1]) + 1 + len(word) > room:
            pieces.append(word)
        else:
            pieces[-1] = f"{pieces[-1]} {word}" if pieces[-1] else word
    return pieces


def encode_line(content: str, checked: bool) -> bytes:
    """``content`` as it is sent, with its end and, if wanted, its checksum."""
    encoded = content.encode("ascii")
    mark = b":%02X" % (256 - sum(encoded[1:]) % 256 & 255) if checked else b""
    return encoded + mark + b"\r\n"
