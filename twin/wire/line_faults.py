"""What may happen to a line of text on its way to the host: functions from a line to the lines that arrive."""

from collections.abc import Callable


def wrong_checksum(line: bytes) -> list[bytes]:
    """Two other digits, if the line ends in a checksum."""
    if line[-5:-4] != b":":
        return [line]
    return [line[:-4] + b"%02X\r\n" % (int(line[-4:-2], 16) ^ 0x55)]


def truncated(line: bytes) -> list[bytes]:
    """The first half and the end of the line."""
    return [line[: len(line) // 2] + b"\r\n"]


def broken_off(line: bytes) -> list[bytes]:
    """The first half without an end, so that the next line is joined to it."""
    return [line[: len(line) // 2]]


def doubled(line: bytes) -> list[bytes]:
    """The line twice."""
    return [line, line]


def preceded_by(*lines: bytes) -> Callable[[bytes], list[bytes]]:
    """The line after others that nobody asked for."""
    return lambda line: [*lines, line]
