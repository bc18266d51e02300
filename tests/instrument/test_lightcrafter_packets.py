"""Framing: what public software sends is reproduced, and no bytes whatever break the reader."""

import random
from pathlib import Path

import pytest

from greenough.instrument import lightcrafter_commands as commands
from greenough.instrument.lightcrafter_commands import Command, Led, Sequence, Trigger, TriggerOut
from greenough.instrument.lightcrafter_packets import (
    HEADER_BYTES,
    MAX_PACKET,
    DamagedPacket,
    Packet,
    PacketReader,
    PacketType,
    Part,
    WrongChecksum,
    WrongFormat,
    encode_packet,
    split,
)

READ, WRITE = PacketType.READ, PacketType.WRITE
BY_COMMAND = Sequence(8, 12, Trigger.COMMAND, period_us=0, exposure_us=16666, led=Led.RED, repeat=1)
BY_TIME = Sequence(8, 12, Trigger.AUTO, period_us=33583, exposure_us=33333, led=Led.GREEN, repeat=0)
REQUESTS = {
    "get mode *": Packet(READ, Command.DISPLAY_MODE),
    "static mode *": Packet(WRITE, Command.DISPLAY_MODE, b"\0"),
    "DM365 version *": Packet(READ, Command.VERSION, bytes([commands.Chip.DM365])),
    "test pattern 0 *": Packet(WRITE, Command.TEST_PATTERN, b"\0"),
    "sequence mode": Packet(WRITE, Command.DISPLAY_MODE, bytes([commands.DisplayMode.PATTERN_SEQUENCE])),
    "LED 255/255/255": Packet(WRITE, Command.LED_CURRENT, commands.pack_current(255, 255, 255)),
    "short-axis flip": Packet(WRITE, Command.DISPLAY_SETTING, bytes([0, 1, 0])),
    "trigger out": Packet(WRITE, Command.TRIGGER_OUT, commands.pack_trigger_out(TriggerOut(1, 0, 0, 200))),
    "12 by command": Packet(WRITE, Command.SEQUENCE, commands.pack_sequence(BY_COMMAND)),
    "12 by time": Packet(WRITE, Command.SEQUENCE, commands.pack_sequence(BY_TIME)),
    "start": Packet(WRITE, Command.START_STOP, b"\1"),
    "stop": Packet(WRITE, Command.START_STOP, b"\0"),
    "advance": Packet(WRITE, Command.ADVANCE),
    "show 5": Packet(WRITE, Command.SHOW, commands.pack_index(5)),
}

SEEDS = range(20)
PACKETS = 100_000


def some_packet(rng: random.Random) -> Packet:
    payload = rng.randbytes(rng.choice([0, 1, 2, 300]))
    return Packet(rng.choice(list(PacketType)), rng.randrange(2**16), payload, rng.choice(list(Part)))


def golden() -> dict[str, bytes]:
    lines = Path(__file__).with_name("lightcrafter_packets.txt").read_text().splitlines()
    return {line[:21].strip(): bytes.fromhex(line[21:]) for line in lines if not line.startswith("#")}


def read_all(reader: PacketReader, received: bytes) -> list[Packet]:
    """All packets, damaged ones included; the reader's bound holds throughout."""
    taken = []
    reader.feed(received)
    while True:
        assert len(reader) <= 2 * MAX_PACKET
        try:
            packet = reader.take()
        except DamagedPacket as damaged:
            packet = damaged.packet
        if packet is None:
            return taken
        taken.append(packet)


@pytest.mark.parametrize("name", golden())
def test_packets_that_public_software_sends_are_reproduced_and_read(name: str) -> None:
    assert encode_packet(REQUESTS[name]) == golden()[name]
    assert read_all(PacketReader(), golden()[name]) == [REQUESTS[name]]


def test_packets_arrive_whole_however_the_stream_is_cut() -> None:
    for seed in SEEDS:
        rng = random.Random(seed)
        sent = [some_packet(rng) for _ in range(5)]
        stream = b"".join(map(encode_packet, sent))
        reader, arrived = PacketReader(), []
        while stream:
            cut = rng.randrange(1, 200)
            arrived += read_all(reader, stream[:cut])
            stream = stream[cut:]
        assert arrived == sent
        assert len(reader) == 0


def test_any_one_wrong_byte_is_found_and_the_next_packet_is_read() -> None:
    packet = encode_packet(Packet(WRITE, Command.PATTERN, bytes(range(40)), Part.FIRST))
    for position in set(range(len(packet))) - {4, 5}:  # a wrong length moves the end
        for change in (1, 0x80, 0xFF):
            data = bytearray(packet)
            data[position] ^= change
            reader = PacketReader()
            reader.feed(bytes(data) + encode_packet(REQUESTS["stop"]))
            with pytest.raises(WrongChecksum):
                reader.take()
            assert reader.take() == REQUESTS["stop"]


@pytest.mark.parametrize("packet", [Packet(6, 0x0101), Packet(255, 0x0101), Packet(READ, 0x0101, b"", 4)])
def test_types_and_parts_that_do_not_exist_are_told_from_wrong_checksums(packet: Packet) -> None:
    reader = PacketReader()
    reader.feed(encode_packet(packet))
    with pytest.raises(WrongFormat) as caught:
        reader.take()
    assert caught.value.packet == packet


@pytest.mark.parametrize(("size", "count"), [(416_951, 7), (1_247_670, 20), (65_535, 1), (65_536, 2), (0, 1)])
def test_long_payloads_are_split_as_public_software_splits_them(size: int, count: int) -> None:
    payload = random.Random(size).randbytes(size)
    parts = split(WRITE, Command.PATTERN, payload)
    assert len(parts) == count
    assert b"".join(part.payload for part in parts) == payload
    if count == 1:
        assert parts[0].part == Part.WHOLE
    else:
        assert [p.part for p in parts] == [Part.FIRST] + [Part.MIDDLE] * (count - 2) + [Part.LAST]
        assert all(len(p.payload) == 65_535 for p in parts[:-1])


def test_a_payload_beyond_one_packet_is_not_sent_as_one() -> None:
    with pytest.raises(ValueError, match="65535"):
        encode_packet(Packet(WRITE, Command.PATTERN, bytes(65_536)))


def test_a_reader_that_nobody_takes_from_stops_growing() -> None:
    reader = PacketReader()
    reader.feed(bytes(2 * MAX_PACKET))
    with pytest.raises(ValueError, match="take"):
        reader.feed(b"\0")
    assert len(reader) == 2 * MAX_PACKET


def test_100_000_random_and_mutated_packets_neither_crash_the_reader_nor_make_it_grow() -> None:
    rng = random.Random(1)
    samples = list(golden().values())
    reader, endless, taken, longest = PacketReader(), PacketReader(), 0, 0
    for number in range(PACKETS):
        if number % 5 == 0:  # a wrong length makes a reader swallow what follows
            reader = PacketReader()
        data = bytearray(rng.choice(samples) if number % 4 else rng.randbytes(rng.randrange(40)))
        if data and number % 2:
            data[rng.randrange(len(data))] = rng.randrange(256)
        taken += len(read_all(reader, bytes(data)))
        read_all(endless, bytes(data))
        longest = max(longest, len(reader), len(endless))
    assert taken > PACKETS / 4
    assert HEADER_BYTES < longest < MAX_PACKET  # what waits is less than one packet
