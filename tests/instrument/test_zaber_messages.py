"""Zaber's ASCII protocol: messages recorded from the vendor's library, and whatever else may come over a wire."""

import random
import tracemalloc

import pytest
from zaber_motion.ascii import WarningFlags

from greenough.instrument.zaber_messages import (
    FLAGS,
    MAX_LINE,
    LineBuffer,
    MalformedMessage,
    Message,
    checksum,
    describe_flag,
    encode_command,
    parse_flags,
    parse_message,
)

RECORDED_COMMANDS = [
    (("home", 1, 1, 1), b"/1 1 01 home:34\n"),
    (("move abs 2000", 1, 1, 10), b"/1 1 10 move abs 2000:EE\n"),
    (("get pos", 1, 1, 0), b"/1 1 00 get pos:2C\n"),
    (("", 1, 1, 2), b"/1 1 02:FC\n"),
    (("warnings clear", 1, 1, 1), b"/1 1 01 warnings clear:4D\n"),
]
MESSAGES = [
    (b"@01 1 18 OK IDLE -- 2000:71", Message("@", 1, 1, 18, data="2000", checked=True)),
    (b"@01 0 RJ BUSY WR BADCOMMAND", Message("@", 1, 0, None, False, True, "WR", "BADCOMMAND")),
    (b"@12 3 99 OK IDLE FS 0", Message("@", 12, 3, 99, flag="FS", data="0")),
    (b"!01 1 IDLE --", Message("!", 1, 1)),
    (b"!01 1 BUSY NC 17", Message("!", 1, 1, busy=True, flag="NC", data="17")),
    (b"#01 0 07 some text", Message("#", 1, 0, 7, data="some text")),
    (b"#01 0 some text", Message("#", 1, 0, data="some text")),
    (b"@01 0 09 OK IDLE -- one two\\", Message("@", 1, 0, 9, data="one two", more=True)),
    (b"#01 0 09 cont three four\\", Message("#", 1, 0, 9, data="three four", more=True, continues=True)),
    (b"#01 0 09 cont five six seven\\:17", None),
    (b"#01 0 09 continued", Message("#", 1, 0, 9, data="continued")),
]
MALFORMED = [
    b"@01 1 18 OK IDLE -- 2000:72",
    b"@01 1 18 OK IDLE -- 2001:71",
    b"@01 1 18 OK IDLE",
    b"@1 1 18 OK IDLE -- 0",
    b"@01 1 18 NO IDLE -- 0",
    b"@01 1 18 OK IDLE -- \x07",
    b"@01 1 18 OK IDLE -- \xe4",
    b"/1 1 01 home:34",
    b"hello",
    b"@",
    b"@01 1 18 OK IDLE -- " + b"9" * MAX_LINE,
]


@pytest.mark.parametrize(("arguments", "line"), RECORDED_COMMANDS)
def test_commands_are_those_of_the_vendors_library(arguments, line):
    assert encode_command(*arguments) == line


@pytest.mark.parametrize(("line", "message"), MESSAGES)
def test_messages_are_read(line, message):
    if message is not None:
        assert parse_message(line) == message
    checked = line if line[-3:-2] == b":" else b"%s:%02X" % (line, checksum(line[1:]))
    read = parse_message(checked)
    assert read.checked
    assert message is None or (read.data, read.more, read.flag) == (message.data, message.more, message.flag)


@pytest.mark.parametrize("line", MALFORMED)
def test_anything_else_is_refused(line):
    with pytest.raises(MalformedMessage):
        parse_message(line)


def test_no_single_wrong_character_passes_the_checksum():
    good = b"@01 1 18 OK IDLE -- 2000:71"
    passed = []
    for place in range(1, len(good)):
        for other in range(32, 127):
            bad = good[:place] + bytes([other]) + good[place + 1 :]
            try:
                message = parse_message(bad)
            except MalformedMessage:
                continue
            if bad != good and message.checked:  # without its colon a line is unchecked, which the driver refuses
                passed.append(bad)
    assert passed == []


def test_flags_are_listed_with_their_count():
    assert parse_flags("00") == ()
    assert parse_flags("01 WR") == ("WR",)
    assert parse_flags("02 FS WR") == ("FS", "WR")
    for data in ("", "0", "01", "00 WR", "01 WR FS", "1 WR", "01 wr", "FS WR", "01  WR"):
        with pytest.raises(MalformedMessage):
            parse_flags(data)


def test_every_flag_of_the_vendor_is_known_and_those_with_f_are_faults():
    assert set(FLAGS) == {code for name, code in vars(WarningFlags).items() if name.isupper()}
    for code, flag in FLAGS.items():
        assert flag.code == code
        assert flag.is_fault == (code[0] == "F")
        assert flag.meaning
        assert flag.remedy
    assert describe_flag("FX").is_fault
    assert not describe_flag("WX").is_fault


def test_lines_are_cut_wherever_the_bytes_are():
    stream = b"@01 1 18 OK IDLE -- 0\r\n\r\n!01 1 IDLE --\n#01 0 x\r"
    lines = [b"@01 1 18 OK IDLE -- 0", b"!01 1 IDLE --", b"#01 0 x"]
    rng = random.Random(3)
    for _ in range(200):
        buffer, got, rest = LineBuffer(), [], stream
        while rest:
            count = rng.randint(1, 9)
            got += buffer.feed(rest[:count])
            rest = rest[count:]
        assert got == lines


def test_a_line_without_end_takes_no_memory():
    buffer = LineBuffer()
    block = b"x" * 65_536
    buffer.feed(block)
    tracemalloc.start()
    for _ in range(500):
        assert buffer.feed(block) == []
    held, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert held < 10_000
    (line,) = buffer.feed(b"\n@01 1 18 OK IDLE -- 0")
    with pytest.raises(MalformedMessage):
        parse_message(line)
    assert buffer.feed(b"\n") == [b"@01 1 18 OK IDLE -- 0"]


@pytest.mark.parametrize("seed", [1, 2])
def test_no_bytes_do_more_than_be_refused(seed):
    rng = random.Random(seed)
    good = [line + end for line, _ in MESSAGES for end in (b"\r\n", b":71\r\n")]
    buffer, lines, read = LineBuffer(), 0, 0
    while lines < 60_000:
        stream = bytearray(b"".join(rng.choices(good, k=50)))
        for _ in range(rng.choice((0, 5, 50))):
            place = rng.randrange(len(stream))
            match rng.randrange(4):
                case 0:
                    stream[place] = rng.randrange(256)
                case 1:
                    del stream[place : place + rng.randrange(9)]
                case 2:
                    stream[place:place] = rng.randbytes(rng.randrange(9))
                case 3:
                    stream[place:place] = stream[place : place + rng.randrange(60)]
        if rng.random() < 0.2:
            stream[:] = rng.randbytes(len(stream))
        for line in buffer.feed(bytes(stream)):
            lines += 1
            try:
                message = parse_message(line)
            except MalformedMessage:
                continue
            read += 1
            assert message.kind in "@#!"
            assert 0 <= message.device <= 99
    assert 0 < read < lines
