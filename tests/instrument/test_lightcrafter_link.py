"""A link to a LightCrafter, whatever a peer on loopback answers."""

import logging
import random
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from greenough.instrument.device_errors import BadReply, ConnectionLost, DeviceError, Rejected, TimedOut
from greenough.instrument.lightcrafter_commands import Command, ErrorCode
from greenough.instrument.lightcrafter_link import BUSY_PAUSE_S, Link, objection
from greenough.instrument.lightcrafter_packets import (
    MAX_PACKET,
    DamagedPacket,
    Packet,
    PacketReader,
    PacketType,
    Part,
    encode_packet,
)

READ, WRITE, REPLY = PacketType.READ, PacketType.WRITE, PacketType.WRITE_REPLY
STOP = Packet(WRITE, Command.START_STOP, b"\0")
STOPPED = encode_packet(Packet(REPLY, Command.START_STOP))
BUSY = encode_packet(Packet(PacketType.BUSY, Command.START_STOP))
PATIENT_S = 60.0
REPLIES = 100_000


@contextmanager
def peer(*replies: bytes, then_close: bool = False) -> Iterator[tuple[int, list[bytes]]]:
    """A port that gives these replies, one to each request, and the requests that came."""
    requests: list[bytes] = []

    def serve() -> None:
        client, _ = listener.accept()
        with client:
            reader, left = PacketReader(), list(replies)
            while received := client.recv(MAX_PACKET):
                reader.feed(received)
                while (packet := reader.take()) is not None:
                    requests.append(encode_packet(packet))
                    if left:
                        client.sendall(left.pop(0))
                    if then_close and not left:
                        return

    with socket.create_server(("127.0.0.1", 0)) as listener:
        thread = threading.Thread(target=serve)
        thread.start()
        try:
            yield listener.getsockname()[1], requests
        finally:
            thread.join(PATIENT_S)
            assert not thread.is_alive()


@contextmanager
def link_to_peer(
    *replies: bytes, then_close: bool = False, timeout_s: float = PATIENT_S, busy_s: float = PATIENT_S
) -> Iterator[tuple[Link, list[bytes]]]:
    """An open link to a peer that gives these replies, and the requests that came there."""
    with peer(*replies, then_close=then_close) as (port, requests):
        link = Link("127.0.0.1", port, timeout_s, busy_s)
        link.open()
        try:
            yield link, requests
        finally:
            link.close()


def names_device_command_and_remedy(error: DeviceError, link: Link, words: str) -> bool:
    text = str(error)
    return link.device in text and words in text and "run again" in text and text.count(".") <= 5


def test_a_command_is_sent_and_its_reply_taken() -> None:
    with link_to_peer(STOPPED, STOPPED) as (link, requests):
        link.write(Command.START_STOP, b"\0")
        link.write(Command.START_STOP, b"\0")
    assert requests == [encode_packet(STOP)] * 2


def test_a_question_is_answered_with_the_payload() -> None:
    with link_to_peer(encode_packet(Packet(PacketType.READ_REPLY, Command.LED_CURRENT, b"abcdef"))) as (link, _):
        assert link.read(Command.LED_CURRENT, size=6) == b"abcdef"


def test_each_part_of_a_long_payload_waits_for_its_own_reply() -> None:
    reply = encode_packet(Packet(REPLY, Command.PATTERN))
    payload = random.Random(2).randbytes(140_000)
    with link_to_peer(reply, reply, reply) as (link, requests):
        link.write(Command.PATTERN, payload)
    assert [data[3] for data in requests] == [Part.FIRST, Part.MIDDLE, Part.LAST]
    assert b"".join(data[6:-1] for data in requests) == payload


def test_a_busy_device_is_asked_again_with_the_same_packet() -> None:
    with link_to_peer(BUSY, BUSY, STOPPED) as (link, requests):
        link.write(Command.START_STOP, b"\0")
        assert link.is_open
    assert requests == [encode_packet(STOP)] * 3


def test_a_device_that_stays_busy_is_given_up() -> None:
    with link_to_peer(*[BUSY] * 100, busy_s=3 * BUSY_PAUSE_S) as (link, requests):
        with pytest.raises(TimedOut, match="idle projector") as caught:
            link.write(Command.START_STOP, b"\0")
        assert link.is_open  # nothing is under way
    assert names_device_command_and_remedy(caught.value, link, Command.START_STOP.words)
    assert 1 <= len(requests) <= 4


@pytest.mark.parametrize("code", [*ErrorCode, 99])
def test_an_error_reply_is_a_rejection_with_its_code_and_leaves_the_link_open(code: int) -> None:
    with link_to_peer(encode_packet(Packet(PacketType.ERROR, Command.START_STOP, bytes([code])))) as (link, _):
        with pytest.raises(Rejected) as caught:
            link.write(Command.START_STOP, b"\0")
        assert link.is_open
    assert caught.value.code == code
    assert (caught.value.meaning == "undocumented") == (code == 99)
    assert names_device_command_and_remedy(caught.value, link, Command.START_STOP.words)


def changed(data: bytes, position: int) -> bytes:
    return data[:position] + bytes([data[position] ^ 1]) + data[position + 1 :]


@pytest.mark.parametrize(
    ("reply", "reason"),
    [
        (changed(STOPPED, -1 % len(STOPPED)), "wrong checksum"),
        (changed(STOPPED, 0), "wrong checksum"),
        (encode_packet(Packet(9, Command.START_STOP)), "unknown type"),
        (encode_packet(Packet(PacketType.READ_REPLY, Command.START_STOP)), "the type 5 instead of 3"),
        (encode_packet(STOP), "the type 2 instead of 3"),
        (encode_packet(Packet(REPLY, Command.ADVANCE)), "the command 0403 instead of 0402"),
        (encode_packet(Packet(REPLY, Command.START_STOP, b"", Part.LAST)), "the part 3"),
        (encode_packet(Packet(PacketType.ERROR, Command.START_STOP)), "no error code"),
    ],
)
def test_a_reply_that_is_none_is_refused_and_the_link_closed(reply: bytes, reason: str) -> None:
    with link_to_peer(reply) as (link, _):
        with pytest.raises(BadReply, match=reason) as caught:
            link.write(Command.START_STOP, b"\0")
        assert not link.is_open
        with pytest.raises(ConnectionLost, match="closed after an error"):
            link.write(Command.START_STOP, b"\0")
    assert names_device_command_and_remedy(caught.value, link, Command.START_STOP.words)


def test_an_answer_of_another_size_is_refused() -> None:
    with (
        link_to_peer(encode_packet(Packet(PacketType.READ_REPLY, Command.LED_CURRENT, b"abcd"))) as (link, _),
        pytest.raises(BadReply, match="4 bytes of payload instead of 6"),
    ):
        link.read(Command.LED_CURRENT, size=6)


def test_a_reply_that_nobody_asked_for_is_not_taken_for_the_next() -> None:
    with link_to_peer(STOPPED + STOPPED, STOPPED) as (link, requests):
        link.write(Command.START_STOP, b"\0")
        with pytest.raises(BadReply, match="before anything was asked"):
            link.write(Command.START_STOP, b"\0")
    assert len(requests) == 1


@pytest.mark.parametrize("reply", [b"", STOPPED[:-1], STOPPED[:3]])
def test_a_device_that_goes_away_is_a_lost_connection(reply: bytes) -> None:
    with link_to_peer(reply, then_close=True) as (link, _), pytest.raises(ConnectionLost) as caught:
        link.write(Command.START_STOP, b"\0")
    assert names_device_command_and_remedy(caught.value, link, Command.START_STOP.words)


@pytest.mark.parametrize("reply", [b"", STOPPED[:-1]])
def test_silence_ends_with_the_timeout(reply: bytes) -> None:
    with link_to_peer(reply, timeout_s=0.1) as (link, _):
        begun = time.monotonic()
        with pytest.raises(TimedOut, match=r"within 0\.1 s") as caught:
            link.write(Command.START_STOP, b"\0")
        assert time.monotonic() - begun >= 0.1
        assert not link.is_open
    assert names_device_command_and_remedy(caught.value, link, Command.START_STOP.words)


def test_a_port_that_nobody_listens_on_is_a_lost_connection() -> None:
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    link = Link("127.0.0.1", port, PATIENT_S, PATIENT_S)
    with pytest.raises(ConnectionLost, match="refused") as caught:
        link.open()
    assert names_device_command_and_remedy(caught.value, link, "connect")


def test_the_wire_is_logged_with_direction_and_bytes(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.DEBUG, "greenough.instrument.lightcrafter.wire")
    with link_to_peer(STOPPED) as (link, _):
        link.write(Command.START_STOP, b"\0")
    sent, received = (record.message for record in caplog.records if "connected" not in record.message)
    assert sent == f"{link.device} > {encode_packet(STOP).hex(' ')}"
    assert received == f"{link.device} < {STOPPED.hex(' ')}"


def test_of_100_000_random_and_mutated_replies_only_those_to_the_request_are_taken() -> None:
    rng = random.Random(3)
    good = Packet(REPLY, Command.START_STOP)
    errors = [Packet(PacketType.ERROR, Command.START_STOP, bytes([code])) for code in ErrorCode]
    samples = [*map(encode_packet, (good, *errors)), BUSY, encode_packet(STOP)]
    taken = 0
    for number in range(REPLIES):
        data = bytearray(rng.choice(samples) if number % 4 else rng.randbytes(rng.randrange(1, 12)))
        if number % 2:
            data[rng.randrange(len(data))] = rng.randrange(256)
            if number % 3:
                data[-1] = sum(data[:-1]) & 0xFF
        reader = PacketReader()
        reader.feed(bytes(data))
        try:
            reply = reader.take()
        except DamagedPacket:
            continue
        if reply is not None and not objection(STOP, reply):
            taken += 1
            assert reply.command == STOP.command
            assert reply.type in (PacketType.BUSY, PacketType.ERROR, REPLY)
            assert reply.type != PacketType.ERROR or reply.payload
    assert 0 < taken < REPLIES
