"""An emulated LightCrafter as a device: what it takes, what it refuses and how, and what it then shows."""

import random
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from greenough.instrument.lightcrafter_bitmap import encode_bitmap
from greenough.instrument.lightcrafter_commands import (
    LONGEST_EXPOSURE_US,
    SHORTEST_EXPOSURE_US,
    Command,
    ErrorCode,
    Led,
    Sequence,
    Trigger,
    pack_current,
    pack_index,
    pack_sequence,
    unpack_sequence,
)
from greenough.instrument.lightcrafter_packets import (
    MAX_PACKET,
    Packet,
    PacketReader,
    PacketType,
    Part,
    encode_packet,
    split,
)
from greenough.twin.wire.lightcrafter import Dialogue, Fault, ResetByFault, at_request
from greenough.twin.wire.lightcrafter_device import LONGEST_PAYLOAD, LightCrafterDevice, Shown

pytestmark = pytest.mark.wire

READ, WRITE = PacketType.READ, PacketType.WRITE
SHAPE = (684, 608)
PACKETS = 100_000
GOLDEN = Path(__file__).parents[2] / "instrument" / "lightcrafter_packets.txt"


class Host:
    """Says packets to a device and hears its replies, without a wire."""

    def __init__(self, device: LightCrafterDevice | None = None, **dialogue: Callable) -> None:
        self.device = device or LightCrafterDevice()
        self.dialogue = Dialogue(self.device, **dialogue)

    def raw(self, data: bytes) -> list[Packet]:
        self.dialogue.hear(data)
        reader, replies = PacketReader(), []
        while (said := self.dialogue.say()) is not None:
            for start in range(0, len(said), MAX_PACKET):
                reader.feed(said[start : start + MAX_PACKET])
                while (reply := reader.take()) is not None:
                    replies.append(reply)
        return replies

    def request(self, packet: Packet) -> Packet:
        (reply,) = self.raw(encode_packet(packet))
        assert reply.command == packet.command
        return reply

    def write(self, command: int, payload: bytes = b"", size: int = 65535) -> ErrorCode | None:
        """The error of the last part, None if there was none."""
        code = None
        for packet in split(WRITE, command, payload, size):
            reply = self.request(packet)
            if reply.type == PacketType.ERROR:
                code = ErrorCode(reply.payload[0])
            else:
                assert reply == Packet(PacketType.WRITE_REPLY, command)
        return code

    def read(self, command: int, payload: bytes = b"") -> bytes | ErrorCode:
        replies = self.raw(encode_packet(Packet(READ, command, payload)))
        if replies[0].type == PacketType.ERROR:
            return ErrorCode(replies[0].payload[0])
        assert {reply.type for reply in replies} == {PacketType.READ_REPLY}
        assert replies[-1].part == (Part.LAST if len(replies) > 1 else Part.WHOLE)
        return b"".join(reply.payload for reply in replies)

    def load(self, levels: np.ndarray, **setting: int) -> None:
        depth = setting.get("depth", 8)
        assert self.write(Command.DISPLAY_MODE, b"\4") is None
        assert self.write(Command.SEQUENCE, pack_sequence(sequence(count=len(levels), **setting))) is None
        for index, image in enumerate(levels):
            assert self.write(Command.PATTERN, bytes([index]) + encode_bitmap(image, depth)) is None


def sequence(**setting: int) -> Sequence:
    default = {"depth": 8, "count": 2, "trigger": 0, "period_us": 0, "exposure_us": 10_000, "led": 1, "repeat": 1}
    return Sequence(**(default | setting))


def levels(count: int, depth: int = 8, seed: int = 4) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 2**depth, (count, *SHAPE), dtype=np.uint8)


def golden() -> dict[str, bytes]:
    lines = GOLDEN.read_text().splitlines()
    return {line[:21].strip(): bytes.fromhex(line[21:]) for line in lines if not line.startswith("#")}


@pytest.mark.parametrize("name", golden())
def test_packets_that_public_software_sends_are_taken(name: str) -> None:
    host = Host()
    host.load(levels(6, 1), depth=1)
    host.write(Command.START_STOP, b"\1")
    data = golden()[name]
    (reply,) = host.raw(data)
    assert reply.type == data[0] + 1
    assert encode_packet(reply)[1:3] == data[1:3]


@pytest.mark.parametrize("depth", range(1, 9))
def test_patterns_of_all_depths_are_shown_as_they_were_sent_and_can_be_read_back(depth: int) -> None:
    host = Host()
    sent = levels(2, depth)
    host.load(sent, depth=depth)
    host.write(Command.START_STOP, b"\1")
    shown = host.device.shown
    assert shown is not None
    np.testing.assert_array_equal(shown.patterns, np.rint(sent * (255 / (2**depth - 1))).astype(np.uint8))
    assert not shown.patterns.flags.writeable
    assert host.read(Command.PATTERN, b"\1") == encode_bitmap(sent[1], depth)


def test_a_bitmap_of_another_writer_in_small_packets_is_taken() -> None:
    host = Host()
    host.load(levels(1))
    grey = levels(1, seed=9)[0]
    _, file = cv2.imencode(".bmp", grey)
    assert host.write(Command.PATTERN, b"\0" + file.tobytes(), size=512) is None
    host.write(Command.START_STOP, b"\1")
    assert host.device.shown is not None
    np.testing.assert_array_equal(host.device.shown.patterns[0], grey)


def test_commands_change_what_is_shown_and_everyone_is_told() -> None:
    told: list[Shown | None] = []
    host = Host(LightCrafterDevice(told.append))
    assert host.device.lit  # after power-up, by a picture of its own
    host.load(levels(3))
    assert told == []
    assert not host.device.lit
    for command, payload in [
        (Command.START_STOP, b"\1"),
        (Command.ADVANCE, b""),
        (Command.ADVANCE, b"\0"),
        (Command.ADVANCE, b""),
        (Command.SHOW, pack_index(1)),
        (Command.START_STOP, b"\0"),
        (Command.SHOW, pack_index(2)),
        (Command.DISPLAY_MODE, b"\4"),
    ]:
        assert host.write(command, payload) is None
        assert told[-1] == host.device.shown
    assert [shown and shown.index for shown in told] == [0, 1, 2, 0, 1, None, 2, None]


def test_a_sequence_without_repetition_ends_in_the_dark() -> None:
    host = Host()
    host.load(levels(2), repeat=0)
    host.write(Command.START_STOP, b"\1")
    assert host.write(Command.ADVANCE) is None
    assert host.write(Command.ADVANCE) is None
    assert not host.device.lit
    assert host.write(Command.ADVANCE) == ErrorCode.NOT_INITIALISED


@pytest.mark.parametrize("repeat", [0, 1])
def test_an_automatic_sequence_runs_by_the_clock_and_is_dark_between_patterns(repeat: int) -> None:
    now = 5.0
    host = Host(LightCrafterDevice(clock=lambda: now))
    host.load(levels(2), trigger=Trigger.AUTO, exposure_us=10_000, period_us=12_000, repeat=repeat)
    host.write(Command.START_STOP, b"\1")
    expected = {0.001: 0, 0.0099: 0, 0.011: None, 0.0121: 1, 0.0230: None, 0.0241: 0 if repeat else None}
    for elapsed, index in expected.items():
        now = 5.0 + elapsed
        shown = host.device.shown
        assert (shown.index if shown else None) == index


def test_a_triggered_sequence_waits_for_its_pulses() -> None:
    host = Host()
    host.load(levels(2), trigger=Trigger.EXTERNAL)
    host.device.trigger()
    assert host.device.shown is None  # not started
    host.write(Command.START_STOP, b"\1")
    assert host.device.shown is None
    assert host.write(Command.ADVANCE) == ErrorCode.NOT_INITIALISED
    seen = []
    for _ in range(3):
        host.device.trigger()
        seen.append(host.device.shown.index if host.device.shown else None)
    assert seen == [0, 1, 0]


def test_inverted_and_flipped_patterns_are_shown_so() -> None:
    host = Host()
    sent = levels(1)
    host.load(sent, pattern_type=1)
    host.write(Command.SHOW, pack_index(0))
    assert host.device.shown is not None
    np.testing.assert_array_equal(host.device.shown.patterns, 255 - sent)
    host.write(Command.DISPLAY_SETTING, b"\1\0\0")
    np.testing.assert_array_equal(host.device.shown.patterns, 255 - sent[:, :, ::-1])
    host.write(Command.DISPLAY_SETTING, b"\0\1\0")
    np.testing.assert_array_equal(host.device.shown.patterns, 255 - sent[:, ::-1])


def test_every_upload_is_told_from_the_last() -> None:
    host = Host()
    host.load(levels(1))
    host.write(Command.SHOW, pack_index(0))
    first = host.device.shown
    host.write(Command.ADVANCE)
    again = host.device.shown
    host.load(levels(1, seed=8))
    host.write(Command.SHOW, pack_index(0))
    last = host.device.shown
    assert first is not None
    assert again is not None
    assert last is not None
    assert first.upload == again.upload < last.upload
    assert first.patterns is again.patterns


def test_currents_are_kept_and_given_back() -> None:
    host = Host()
    assert host.write(Command.LED_CURRENT, pack_current(1, 300, 65535)) is None
    assert host.read(Command.LED_CURRENT) == pack_current(1, 300, 65535)
    assert host.device.led_current == (1, 300, 65535)


@pytest.mark.parametrize("depth", SHORTEST_EXPOSURE_US)
def test_exposures_are_raised_silently_and_refused_above_the_limit(depth: int) -> None:
    host = Host()
    assert host.write(Command.SEQUENCE, pack_sequence(sequence(depth=depth, exposure_us=1))) is None
    answer = host.read(Command.SEQUENCE)
    assert isinstance(answer, bytes)
    assert unpack_sequence(answer).exposure_us == SHORTEST_EXPOSURE_US[depth]
    longest = LONGEST_EXPOSURE_US[depth]
    assert host.write(Command.SEQUENCE, pack_sequence(sequence(depth=depth, exposure_us=longest))) is None
    too_long = pack_sequence(sequence(depth=depth, exposure_us=longest + 1))
    assert host.write(Command.SEQUENCE, too_long) == ErrorCode.INVALID_PARAMETER


@pytest.mark.parametrize(
    ("command", "payload", "code"),
    [
        (0x0105, b"", ErrorCode.UNSUPPORTED),
        (0xFFFF, b"", ErrorCode.UNSUPPORTED),
        (Command.DISPLAY_MODE, b"\5", ErrorCode.INVALID_PARAMETER),
        (Command.DISPLAY_MODE, b"", ErrorCode.PACKET_FORMAT),
        (Command.TEST_PATTERN, b"\x0e", ErrorCode.INVALID_PARAMETER),
        (Command.LED_CURRENT, b"\0" * 5, ErrorCode.PACKET_FORMAT),
        (Command.DISPLAY_SETTING, b"\0\0\1", ErrorCode.INVALID_PARAMETER),
        (Command.SEQUENCE, b"\0" * 18, ErrorCode.PACKET_FORMAT),
        (Command.SEQUENCE, pack_sequence(sequence(depth=0)), ErrorCode.INVALID_PARAMETER),
        (Command.SEQUENCE, pack_sequence(sequence(depth=9)), ErrorCode.INVALID_PARAMETER),
        (Command.SEQUENCE, pack_sequence(sequence(count=0)), ErrorCode.INVALID_PARAMETER),
        (Command.SEQUENCE, pack_sequence(sequence(count=13)), ErrorCode.OUT_OF_MEMORY),
        (Command.SEQUENCE, pack_sequence(sequence(depth=1, count=97)), ErrorCode.OUT_OF_MEMORY),
        (Command.SEQUENCE, pack_sequence(sequence(trigger=7)), ErrorCode.INVALID_PARAMETER),
        (Command.SEQUENCE, pack_sequence(sequence(led=4)), ErrorCode.INVALID_PARAMETER),
        (Command.SEQUENCE, pack_sequence(sequence(repeat=2)), ErrorCode.INVALID_PARAMETER),
        (Command.SEQUENCE, pack_sequence(sequence(pattern_type=2)), ErrorCode.UNSUPPORTED),
        (Command.SEQUENCE, pack_sequence(sequence(trigger=1, period_us=9_999)), ErrorCode.INVALID_PARAMETER),
        (Command.START_STOP, b"\2", ErrorCode.INVALID_PARAMETER),
        (Command.SHOW, pack_index(2), ErrorCode.INVALID_PARAMETER),
        (Command.SHOW, b"\0", ErrorCode.PACKET_FORMAT),
        (Command.ADVANCE, b"\1", ErrorCode.PACKET_FORMAT),
        (Command.ADVANCE, b"", ErrorCode.NOT_INITIALISED),
        (Command.TRIGGER_OUT, b"\1\1" + b"\0" * 9, ErrorCode.INVALID_PARAMETER),
        (Command.PATTERN, b"\2" + encode_bitmap(levels(1)[0], 8), ErrorCode.INVALID_PARAMETER),
        (Command.PATTERN, b"\0" + encode_bitmap(levels(1, 4)[0], 4), ErrorCode.PACKET_FORMAT),
        (Command.PATTERN, b"\0PM" + encode_bitmap(levels(1)[0], 8)[2:], ErrorCode.INVALID_PARAMETER),
    ],
)
def test_what_the_device_refuses_has_its_code_and_changes_nothing(
    command: int, payload: bytes, code: ErrorCode
) -> None:
    host = Host()
    host.load(levels(2))
    before = [host.read(c) for c in (Command.SEQUENCE, Command.LED_CURRENT, Command.DISPLAY_MODE, Command.TRIGGER_OUT)]
    assert host.write(command, payload) == code
    assert before == [
        host.read(c) for c in (Command.SEQUENCE, Command.LED_CURRENT, Command.DISPLAY_MODE, Command.TRIGGER_OUT)
    ]
    assert not host.device.lit


@pytest.mark.parametrize("command", [Command.START_STOP, Command.SHOW])
def test_nothing_is_lit_before_all_patterns_are_there(command: Command) -> None:
    host = Host()
    payload = b"\1" if command == Command.START_STOP else pack_index(0)
    assert host.write(command, payload) == ErrorCode.NOT_INITIALISED
    host.write(Command.DISPLAY_MODE, b"\4")
    host.write(Command.SEQUENCE, pack_sequence(sequence(count=2)))
    host.write(Command.PATTERN, b"\0" + encode_bitmap(levels(1)[0], 8))
    assert host.write(command, payload) == ErrorCode.NOT_INITIALISED
    assert not host.device.lit


def test_damaged_packets_are_answered_by_their_code_and_not_executed() -> None:
    host = Host()
    wrong_sum = bytearray(encode_packet(Packet(WRITE, Command.LED_CURRENT, pack_current(9, 9, 9))))
    wrong_sum[-1] ^= 1
    for data, code in [
        (bytes(wrong_sum), ErrorCode.CHECKSUM),
        (encode_packet(Packet(7, Command.LED_CURRENT, pack_current(9, 9, 9))), ErrorCode.PACKET_FORMAT),
        (encode_packet(Packet(3, Command.LED_CURRENT, pack_current(9, 9, 9))), ErrorCode.PACKET_FORMAT),
        (encode_packet(Packet(WRITE, Command.LED_CURRENT, b"\0\0", Part.LAST)), ErrorCode.CONTINUATION),
        (encode_packet(Packet(READ, Command.LED_CURRENT, b"", Part.FIRST)), ErrorCode.CONTINUATION),
    ]:
        assert host.raw(data) == [Packet(PacketType.ERROR, Command.LED_CURRENT, bytes([code]))]
    assert host.device.led_current == (0, 0, 0)


def test_a_payload_without_end_is_refused_before_it_fills_the_memory() -> None:
    host = Host()
    host.load(levels(1))
    part = bytes(65_535)
    assert host.request(Packet(WRITE, Command.PATTERN, part, Part.FIRST)).type == PacketType.WRITE_REPLY
    replies = [host.request(Packet(WRITE, Command.PATTERN, part, Part.MIDDLE)) for _ in range(10)]
    assert replies[4].type == PacketType.WRITE_REPLY
    assert replies[5].payload == bytes([ErrorCode.PACKET_FORMAT])
    assert replies[9].payload == bytes([ErrorCode.CONTINUATION])
    assert host.dialogue.held_bytes == 0


def test_faults_come_at_the_request_that_was_named() -> None:
    stop = encode_packet(Packet(WRITE, Command.START_STOP, b"\0"))
    reply = encode_packet(Packet(PacketType.WRITE_REPLY, Command.START_STOP))
    expected = {
        Fault.BUSY: encode_packet(Packet(PacketType.BUSY, Command.START_STOP)),
        Fault.FAILED: encode_packet(Packet(PacketType.ERROR, Command.START_STOP, b"\1")),
        Fault.SILENCE: b"",
        Fault.WRONG_CHECKSUM: reply[:-1] + bytes([reply[-1] ^ 0xFF]),
        Fault.TRUNCATED: reply[:-1],
        Fault.TWICE: reply + reply,
    }
    for fault, said in expected.items():
        dialogue = Dialogue(LightCrafterDevice(), at_request(1, fault, count=2))
        heard = []
        for _ in range(4):
            dialogue.hear(stop)
            heard.append(dialogue.say())
        assert heard == [reply, said, said, reply]
    dialogue = Dialogue(LightCrafterDevice(), at_request(0, Fault.RESET))
    dialogue.hear(stop)
    with pytest.raises(ResetByFault):
        dialogue.say()


def mutated(rng: random.Random, samples: list[bytes]) -> bytes:
    """A request of another program, random bytes, or a request with random payload; half of them then changed."""
    kind = rng.randrange(4)
    if kind == 0:
        data = rng.randbytes(rng.randrange(40))
    elif kind == 1:
        data = rng.choice(samples)
    else:
        payload = rng.randbytes(rng.choice([0, 1, 2, 3, 6, 11, 19]))
        if len(payload) == 19:
            setting = sequence(
                depth=rng.choice([1, 8, 9]), count=rng.choice([1, 2, 12, 13]), trigger=rng.randrange(8),
                period_us=rng.choice([0, 1, 20_000]), led=rng.choice(list(Led)), repeat=rng.randrange(2),
            )  # fmt: skip
            payload = pack_sequence(setting)
        command = rng.choice([*Command, rng.randrange(2**16)])
        data = encode_packet(Packet(rng.choice([READ, WRITE]), command, payload, rng.choice([0, 0, 0, 1, 2, 3])))
    if data and rng.random() < 0.5:
        changed = bytearray(data)
        changed[rng.randrange(len(changed))] = rng.randrange(256)
        if rng.random() < 0.5:
            changed[-1] = sum(changed[:-1]) & 0xFF
        data = bytes(changed)
    return data


@pytest.mark.slow
def test_100_000_random_and_mutated_packets_are_answered_by_whole_packets_and_held_within_bounds() -> None:
    rng = random.Random(5)
    samples = list(golden().values())
    device = LightCrafterDevice()
    Host(device).load(levels(2, 1), depth=1)
    answered: set[tuple[int, bytes]] = set()
    for number in range(PACKETS):
        if number % 5 == 0:  # a wrong length makes it swallow what follows
            host = Host(device)
        for reply in host.raw(mutated(rng, samples)):
            answered.add((reply.type, reply.payload if reply.type == PacketType.ERROR else b""))
        assert host.dialogue.held_bytes <= MAX_PACKET + LONGEST_PAYLOAD
    shown_as = {reply_type for reply_type, _ in answered}
    assert shown_as == {PacketType.ERROR, PacketType.WRITE_REPLY, PacketType.READ_REPLY}
    codes = {ErrorCode(payload[0]) for reply_type, payload in answered if reply_type == PacketType.ERROR}
    assert codes >= set(ErrorCode) - {ErrorCode.FAILED, ErrorCode.DEVICE_FAILED, ErrorCode.DEVICE_BUSY}
