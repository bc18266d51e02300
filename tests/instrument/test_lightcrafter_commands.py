"""Payloads and limits of a LightCrafter's commands."""

import random
import struct
from collections.abc import Callable

import pytest

from greenough.instrument.lightcrafter_commands import (
    Command,
    ErrorCode,
    Sequence,
    TriggerOut,
    batches,
    pack_sequence,
    pack_trigger_out,
    patterns_in_memory,
    unpack_current,
    unpack_index,
    unpack_sequence,
    unpack_trigger_out,
)


def numbers(rng: random.Random, *bits: int) -> list[int]:
    """The least, the greatest, or any unsigned integer of so many bits each."""
    return [rng.choice([0, 2**n - 1, rng.randrange(2**n)]) for n in bits]


def test_settings_arrive_as_they_were_sent() -> None:
    rng = random.Random(1)
    for _ in range(200):
        sequence = Sequence(*numbers(rng, 8, 16, 8, 32, 32, 8, 8, 32, 8))
        assert len(pack_sequence(sequence)) == 19
        assert unpack_sequence(pack_sequence(sequence)) == sequence
        trigger = TriggerOut(*numbers(rng, 8, 8, 32, 32, 8))
        assert len(pack_trigger_out(trigger)) == 11
        assert unpack_trigger_out(pack_trigger_out(trigger)) == trigger


@pytest.mark.parametrize(
    ("unpack", "length"), [(unpack_sequence, 19), (unpack_trigger_out, 11), (unpack_current, 6), (unpack_index, 2)]
)
def test_payloads_of_another_length_are_refused(unpack: Callable[[bytes], object], length: int) -> None:
    unpack(bytes(length))
    for other in set(range(25)) - {length}:
        with pytest.raises(struct.error):
            unpack(bytes(other))


def test_as_many_patterns_fit_as_the_makers_table_says() -> None:
    assert [patterns_in_memory(depth) for depth in range(1, 9)] == [96, 48, 32, 24, 16, 16, 12, 12]


def test_the_papers_24_patterns_are_two_uploads_of_12() -> None:
    assert batches(24) == [12, 12]


@pytest.mark.parametrize("depth", range(1, 9))
def test_batches_hold_all_patterns_and_none_is_longer_than_the_memory(depth: int) -> None:
    for count in (0, 1, 2, 5, 24, 97, 300):
        lengths = batches(count, depth)
        assert sum(lengths) == count
        assert all(1 <= length <= patterns_in_memory(depth) for length in lengths)
        assert lengths == sorted(lengths, reverse=True)


def test_batches_of_8_bits_are_sequences_that_the_makers_software_knows() -> None:
    assert {length for count in range(1, 100) for length in batches(count)} == {1, 2, 3, 4, 6, 8, 12}


def test_every_command_and_error_has_words() -> None:
    assert len({command.words for command in Command}) == len(Command)
    assert [code.value for code in ErrorCode] == list(range(1, 12))
    assert ErrorCode.OUT_OF_MEMORY.words == "out of memory"
