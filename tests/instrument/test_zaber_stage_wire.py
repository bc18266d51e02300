"""Whatever the wire to a stage does, over either port, ends in a typed error, in time, at rest, or changes nothing."""

import contextlib
import itertools
import logging
import os
import random
import threading

import pytest
import serial
from emulated_zaber import MICROSTEP_UM, REPLY_S, ZERO, hurried, hurry, opened, options

from greenough.instrument.device_errors import BadReply, ConnectionLost, DeviceError, TimedOut
from greenough.instrument.zaber_stage import ZaberStage
from greenough.twin.wire.line_faults import broken_off, doubled, preceded_by, truncated, wrong_checksum
from greenough.twin.wire.line_server import LineServer
from greenough.twin.wire.zaber import StageModel


@pytest.mark.parametrize(
    ("how", "kinds"),
    [
        (wrong_checksum, BadReply),
        (truncated, BadReply),
        (broken_off, (TimedOut, BadReply)),
        (lambda line: [], TimedOut),
        (lambda line: [line[:-5] + b"\r\n"], BadReply),  # its checksum alone is missing
    ],
)
@pytest.mark.parametrize("message", [1, 2, 3, 4])
def test_a_damaged_reply_at_any_point_is_never_taken_for_an_answer(how, kinds, message):
    with opened() as (device, _, stage):
        stage.move_to_mm(-0.5)
        damaged = device.messages + message
        device.at_message(damaged, lambda: device.spoil(how))
        waiting = contextlib.nullcontext() if kinds is BadReply else hurried(device, stage, damaged)
        with waiting, pytest.raises(kinds) as error:
            stage.move_to_mm(0.5)
        assert "Zaber stage 1 on" in str(error.value)
        assert not device.moves
        stage.move_to_mm(0.25)  # and the next exchange is sound
        assert stage.position_mm == pytest.approx(0.25, abs=MICROSTEP_UM * 1e-3)


STRANGERS = [
    b"!01 1 IDLE --\r\n",
    b"!01 1 BUSY NC 17:00\r\n",
    b"#01 0 something happened\r\n",
    b"#01 1 cont something\r\n",
    b"@02 1 OK IDLE -- 999\r\n",
    b"@01 1 OK IDLE -- 999\r\n",
    b"@01 2 OK IDLE -- 999\r\n",
    b"\r\n\r\n",
    b"\xff\xfe rubbish \x00\r\n",
    b"x" * 5000 + b"\r\n",
]


def test_what_nobody_asked_for_is_left_aside():
    with opened() as (device, _, stage):
        for number, stranger in enumerate(STRANGERS * 2):
            device.at_message(device.messages + 1 + number % 4, lambda line=stranger: device.spoil(preceded_by(line)))
            target = 0.1 * (number % 10)
            stage.move_to_mm(target)
            assert stage.position_mm == pytest.approx(target, abs=MICROSTEP_UM * 1e-3)


def test_a_reply_that_comes_twice_or_too_late_answers_nothing_else():
    with opened() as (device, _, stage):
        stage.move_to_mm(0.5)
        device.spoil(doubled)
        first = stage.position_mm
        stage.move_to_mm(-0.5)
        assert stage.position_mm == pytest.approx(first - 1.0, abs=MICROSTEP_UM * 2e-3)
        device.delay()
        with hurried(device, stage, device.messages + 1), pytest.raises(TimedOut):
            _ = stage.position_mm
        device.turn_knob(2000)
        assert stage.position_mm == pytest.approx(-0.5 + 2 * MICROSTEP_UM, abs=MICROSTEP_UM * 1e-3)


class Chatterer:
    """A device that never stops alerting and answers nothing."""

    moves = True

    def answer(self, line: bytes) -> list[bytes]:
        return []

    def tick(self) -> list[bytes]:
        return [b"!01 1 IDLE --\r\n"] * 20


@pytest.mark.timeout(120)
def test_a_flood_of_alerts_does_not_make_a_wait_endless():
    with LineServer(Chatterer()) as server, pytest.raises(TimedOut):
        ZaberStage(options(server.terminal, reply_timeout_s=REPLY_S), (-1, 1)).connect()


def test_an_answer_behind_many_alerts_is_found():
    with opened() as (device, _, stage):
        stage.move_to_mm(0.5)
        device.spoil(preceded_by(*[b"!01 1 IDLE --\r\n"] * 3000))  # more than a terminal holds
        assert stage.position_mm == pytest.approx(0.5, abs=MICROSTEP_UM * 1e-3)


@pytest.mark.timeout(120)
@pytest.mark.parametrize("terminal", [True, False], ids=["terminal", "tcp"])
def test_silence_ends_in_the_stated_time(terminal):
    with contextlib.ExitStack() as held:
        device, _, stage = held.enter_context(opened(terminal=terminal))
        device.fall_silent()
        with hurried(device, stage, device.messages + 1):
            with pytest.raises(TimedOut, match=r"an answer did not come within 0\.4 s"):
                stage.move_to_mm(0.5)
            with pytest.raises(TimedOut):  # leaving tells, too, that rest could not be confirmed
                held.close()


@pytest.mark.parametrize("terminal", [True, False], ids=["terminal", "tcp"])
@pytest.mark.parametrize("message", [1, 2, 3, 4])
def test_a_port_that_is_pulled_out_is_told_and_no_answer_is_waited_for(terminal, message):
    with contextlib.ExitStack() as held:
        device, server, stage = held.enter_context(opened(terminal=terminal))
        device.at_message(device.messages + message, server.close)
        with pytest.raises(ConnectionLost):  # a wait would end in TimedOut
            stage.move_to_mm(0.5)
        with pytest.raises(ConnectionLost):
            held.close()


FAULTS = {
    "stall": lambda device, server: device.stall(),
    "emergency stop": lambda device, server: device.press_emergency_stop(),
    "never arrives": lambda device, server: device.hang(),
    "knob": lambda device, server: device.turn_knob(-700),
    "power": lambda device, server: device.switch_off_and_on(),
    "wrong checksum": lambda device, server: device.spoil(wrong_checksum),
    "truncated": lambda device, server: device.spoil(truncated),
    "broken off": lambda device, server: device.spoil(broken_off),
    "twice": lambda device, server: device.spoil(doubled),
    "late": lambda device, server: device.delay(),
    "unsolicited": lambda device, server: device.spoil(preceded_by(*STRANGERS)),
    "silence": lambda device, server: device.fall_silent(),
    "port gone": lambda device, server: server.close(),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_no_fault_at_any_point_of_a_scan_ends_in_a_wrong_position(fault):
    """A position that is given out is the true one, and a scan that does not end is told why, and is at rest."""
    rng = random.Random(fault)
    unanswered = fault in ("silence", "late", "broken off")
    settings = {"settle_timeout_s": 0.2} if fault == "never arrives" else {}
    for message in rng.sample(range(1, 20), 2 if unanswered or settings else 6):
        with contextlib.ExitStack() as held:
            device, server, stage = held.enter_context(opened(**settings))
            struck = device.messages + message
            device.at_message(struck, lambda d=device, s=server: FAULTS[fault](d, s))
            if unanswered:
                hurry(device, stage, struck)
            told = None
            try:
                for target in (0.4, -0.4, 0.0, 0.8):  # five messages each, and leaving
                    stage.move_to_mm(target)
                    reading = stage.position_mm
                    assert (device.position - ZERO) * MICROSTEP_UM * 1e-3 == pytest.approx(reading, abs=1e-9)
                held.close()
            except DeviceError as error:
                told = error
                with contextlib.suppress(DeviceError):
                    held.close()
            assert not device.moves
            assert told is None or fault not in ("twice", "unsolicited")


@pytest.mark.parametrize(
    "port", ["/dev/there-is-none", "socket://127.0.0.1:1", "socket://nowhere", "nonsense://x", "/dev/null"]
)
def test_a_port_that_cannot_be_opened_is_told(port):
    with pytest.raises(ConnectionLost, match="check cable, power and baud rate") as error:
        ZaberStage(options(port), (-1, 1)).connect()
    assert str(error.value).isprintable()


def test_a_port_in_use_is_told():
    with opened() as (_, server, _), pytest.raises(ConnectionLost):
        ZaberStage(options(server.terminal), (-1, 1)).connect()


@pytest.mark.parametrize("packet", [80, 40])
def test_replies_in_pieces_are_put_together(packet):
    with opened(StageModel(travel=200_000, start=ZERO, instant=True, packet=packet)) as (_, _, stage):
        words = "one two three four five six seven"
        assert stage._ask(f"tools echo {words}", 0).data == words


def test_firmware_that_must_be_told_to_send_checksums_is_told():
    model = StageModel(travel=200_000, start=ZERO, instant=True, mirrors_checksums=False)
    with opened(model) as (device, _, stage):
        device.spoil(wrong_checksum)
        with pytest.raises(BadReply, match="the checksum"):
            _ = stage.position_mm


def test_commands_bear_ids_and_checksums_and_the_log_has_both_directions(caplog):
    with caplog.at_level(logging.DEBUG, "greenough.instrument.zaber_link"), opened() as (_, server, stage):
        stage.move_to_mm(0.0)
    lines = [record.getMessage() for record in caplog.records if "zaber_link." in record.name]
    sent = [line[2:] for line in lines if line[0] == ">"]
    assert all(line.startswith("/1 ") and line[-3] == ":" for line in sent)
    ids = [int(line.split(":")[0].split()[2]) for line in sent]
    assert all((after - before) % 100 == 1 for before, after in itertools.pairwise(ids))
    assert any("move abs 100000" in line for line in sent)
    assert sum(line[0] == "<" for line in lines) == len(sent)
    assert all(server.terminal in record.name for record in caplog.records if "zaber_link." in record.name)


def test_nothing_is_left_of_a_stage_after_leaving_or_failing():
    with opened():
        pass
    threads, files = threading.active_count(), set(os.listdir("/proc/self/fd"))
    for fault in (None, lambda device, server: server.close(), lambda device, server: device.fall_silent()):
        with contextlib.suppress(DeviceError), opened() as (device, server, stage):
            if fault:
                fault(device, server)
                hurry(device, stage, device.messages + 1)
            stage.move_to_mm(0.1)
    with contextlib.suppress(DeviceError), opened(limits_mm=(50.0, 60.0)):
        pass
    assert threading.active_count() == threads
    assert set(os.listdir("/proc/self/fd")) == files


def test_any_serial_port_of_pyserial_will_do():
    """A loop-back port answers with what was sent, which is no reply."""
    with pytest.raises(TimedOut):
        ZaberStage(options("loop://", reply_timeout_s=REPLY_S), (-1, 1)).connect()
    assert serial.serial_for_url("loop://", do_not_open=True).port == "loop://"
