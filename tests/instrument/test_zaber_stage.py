"""The driver keeps the contract over either port, and whatever goes wrong ends in a typed error, in time, at rest."""

import contextlib
import itertools
import logging
import os
import random
import threading
import time

import pytest
import serial

from greenough.instrument.device_errors import BadReply, ConnectionLost, DeviceError, Fault, Rejected, TimedOut
from greenough.instrument.errors import InputError
from greenough.instrument.zaber_stage import ZaberSettings, ZaberStage
from greenough.twin.wire.line_faults import broken_off, doubled, preceded_by, truncated, wrong_checksum
from greenough.twin.wire.line_server import LineServer
from greenough.twin.wire.zaber import StageModel, ZaberDevice

MICROSTEP_UM, ZERO = 0.047625, 100_000
INSTANT = StageModel(travel=200_000, start=30_000, instant=True)
REPLY_S = 0.4  # where answers fail to come; where they come, a busy machine may take its time
SLACK_S = 20.0  # of a busy machine; nothing is judged by it but that waits end


@contextlib.contextmanager
def opened(model=INSTANT, terminal=True, limits_mm=(-1.6, 1.6), homed=True, **settings):
    """(device, server, stage) with the stage connected, and homed unless told otherwise."""
    device = ZaberDevice(model)
    with LineServer(device) as server:
        port = server.terminal if terminal else server.url
        with ZaberStage(options(port, **settings), limits_mm) as stage:
            if homed:
                stage.home()
            yield device, server, stage


def options(port: str, **settings) -> ZaberSettings:
    values = {
        "microstep_um": MICROSTEP_UM,
        "zero_microsteps": ZERO,
        "reply_timeout_s": 10.0,
        "settle_timeout_s": 20.0,
        "home_timeout_s": 60.0,
    }
    return ZaberSettings(port=port, **(values | settings))


def heard(device: ZaberDevice) -> list[str]:
    """A growing list of what the device is told."""
    commands, answer = [], device.answer

    def listen(line: bytes) -> list[bytes]:
        commands.append(line.decode().partition(":")[0].split(maxsplit=3)[3:])
        return answer(line)

    device.answer = listen
    return commands


@pytest.mark.parametrize("terminal", [True, False], ids=["terminal", "tcp"])
def test_it_homes_moves_and_reads_back(terminal):
    with opened(terminal=terminal) as (device, _, stage):
        for target in (0.0, 1.0, -1.0, 0.3):
            stage.move_to_mm(target)
            assert stage.position_mm == pytest.approx(target, abs=MICROSTEP_UM * 0.51e-3)
            assert (device.position - ZERO) * MICROSTEP_UM * 1e-3 == pytest.approx(stage.position_mm, abs=1e-12)
        assert stage.identity.firmware == "7.38"
        assert stage.identity.serial == "31415"


@pytest.mark.parametrize("direction", [1, -1])
def test_direction_and_zero_are_the_rig_files(direction):
    with opened(direction=direction, zero_microsteps=90_000) as (device, _, stage):
        stage.move_to_mm(0.0)
        assert device.position == 90_000
        stage.move_to_mm(1.0)
        assert (device.position - 90_000) * direction * MICROSTEP_UM == pytest.approx(1000, abs=MICROSTEP_UM)
        assert stage.position_mm == pytest.approx(1.0, abs=MICROSTEP_UM * 1e-3)


def test_it_moves_in_its_own_time_and_waits():
    model = StageModel(travel=200_000, start=ZERO, maxspeed=4_000_000, accel=5000)
    with opened(model) as (device, _, stage):
        stage.move_to_mm(-1.0)
        assert not device.moves
        began = time.monotonic()
        stage.move_to_mm(1.0)
        assert time.monotonic() - began > 0.05  # 42 000 microsteps there, of which it cannot skip any
        assert not device.moves
        assert device.position == pytest.approx(ZERO + 1000 / MICROSTEP_UM, abs=0.5)


def test_connecting_moves_nothing_and_tells_whether_it_is_homed():
    with opened(homed=False) as (device, _, stage):
        assert not stage.homed
        assert stage.warnings() == ("WR",)
        assert device.position == INSTANT.start
        stage.home()
        assert stage.homed


def test_limits_of_rig_file_and_device_both_apply():
    with opened(limits_mm=(-1.6, 99.0)) as (_, _, stage):
        low, high = stage.limits_mm
        assert low == -1.6
        assert high == pytest.approx((INSTANT.travel - ZERO) * MICROSTEP_UM * 1e-3)
        stage.move_to_mm(high)
    with opened(limits_mm=(-99.0, 1.6), direction=-1) as (_, _, stage):
        assert stage.limits_mm == (pytest.approx(-(INSTANT.travel - ZERO) * MICROSTEP_UM * 1e-3), 1.6)


def test_limits_that_have_nothing_in_common_are_refused_on_connecting():
    with pytest.raises(DeviceError, match="zero_microsteps"), opened(limits_mm=(50.0, 60.0)):
        pass


@pytest.mark.parametrize("position", [1.601, -1.601, float("nan"), float("inf")])
def test_out_of_range_is_refused_before_anything_is_sent(position):
    with opened() as (device, _, stage):
        before = device.messages
        with pytest.raises(InputError, match=r"outside its limits, -1\.6 to 1\.6 mm"):
            stage.move_to_mm(position)
        assert device.messages == before


@pytest.mark.parametrize("ask", [lambda stage: stage.move_to_mm(0.1), lambda stage: stage.position_mm])
def test_an_unhomed_stage_says_what_to_do_and_moves_nowhere(ask):
    with opened(homed=False) as (device, _, stage):
        with pytest.raises(Fault, match="home the stage") as fault:
            ask(stage)
        assert fault.value.flag == "WR"
        assert device.position == INSTANT.start


def test_a_stall_is_told_and_homing_recovers_from_it():
    with opened() as (device, _, stage):
        device.stall()
        with pytest.raises(Fault, match=r"FS \(stalled and stopped\)") as fault:
            stage.move_to_mm(1.0)
        assert fault.value.command == f"move abs {ZERO + round(1000 / MICROSTEP_UM)}"
        with pytest.raises(Fault, match="FS"):  # no number of a stage at fault
            _ = stage.position_mm
        stage.home()
        stage.move_to_mm(1.0)


def test_an_emergency_stop_is_told_until_it_is_released():
    with opened() as (device, _, stage):
        device.at_message(device.messages + 2, device.press_emergency_stop)  # after it was found in order
        for attempt in (lambda: stage.move_to_mm(0.5), stage.home):
            with pytest.raises(Fault, match="release the emergency stop"):
                attempt()
        device.release_emergency_stop()
        stage.home()
        stage.move_to_mm(0.5)


def test_an_emergency_stop_on_the_way_ends_the_waiting():
    model = StageModel(travel=200_000, start=ZERO, maxspeed=20_000, accel=0)
    with opened(model, homed=False, home_timeout_s=60) as (device, _, stage):
        threading.Timer(0.1, device.press_emergency_stop).start()
        began = time.monotonic()
        with pytest.raises(Fault, match="FH"):
            stage.home()
        assert time.monotonic() - began < SLACK_S
        assert not device.moves


def test_a_stage_that_never_arrives_is_stopped_and_told():
    with opened(settle_timeout_s=0.2) as (device, _, stage):
        commands = heard(device)
        device.hang()
        with pytest.raises(TimedOut, match="the end of the motion"):
            stage.move_to_mm(0.5)
        assert ["stop"] in commands
        assert not device.moves


def test_a_motion_that_somebody_interrupts_is_told():
    with opened() as (device, _, stage):
        device.at_message(device.messages + 3, lambda: device.turn_knob(-500))  # pos, move, then the status
        with pytest.raises(Fault, match="NC"):
            stage.move_to_mm(0.5)
        stage.move_to_mm(0.5)  # the next motion is nobody's but ours


def test_a_stage_that_is_elsewhere_without_a_flag_is_told():
    with opened() as (device, _, stage):

        def slip() -> None:
            device.turn_knob(-500)
            device.answer(b"/1 1 warnings clear")

        device.at_message(device.messages + 3, slip)
        with pytest.raises(DeviceError, match="stands at"):
            stage.move_to_mm(0.5)


def test_a_reset_controller_is_noticed():
    with opened() as (device, _, stage):
        stage.move_to_mm(0.5)
        device.switch_off_and_on()
        with pytest.raises(Fault, match="WR"):
            _ = stage.position_mm


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
    with opened(reply_timeout_s=10.0 if kinds is BadReply else REPLY_S) as (device, _, stage):
        stage.move_to_mm(-0.5)
        device.at_message(device.messages + message, lambda: device.spoil(how))
        began = time.monotonic()
        with pytest.raises(kinds) as error:
            stage.move_to_mm(0.5)
        assert time.monotonic() - began < 4 * REPLY_S + SLACK_S
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
    with opened(reply_timeout_s=REPLY_S) as (device, _, stage):
        stage.move_to_mm(0.5)
        device.spoil(doubled)
        first = stage.position_mm
        stage.move_to_mm(-0.5)
        assert stage.position_mm == pytest.approx(first - 1.0, abs=MICROSTEP_UM * 2e-3)
        device.delay()
        with pytest.raises(TimedOut):
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


def test_a_flood_of_alerts_does_not_make_a_wait_endless():
    with LineServer(Chatterer()) as server:
        began = time.monotonic()
        with pytest.raises(TimedOut):
            ZaberStage(options(server.terminal, reply_timeout_s=REPLY_S), (-1, 1)).connect()
        assert time.monotonic() - began < REPLY_S + SLACK_S


def test_an_answer_behind_many_alerts_is_found():
    with opened() as (device, _, stage):
        stage.move_to_mm(0.5)
        device.spoil(preceded_by(*[b"!01 1 IDLE --\r\n"] * 3000))  # more than a terminal holds
        assert stage.position_mm == pytest.approx(0.5, abs=MICROSTEP_UM * 1e-3)


@pytest.mark.parametrize("terminal", [True, False], ids=["terminal", "tcp"])
def test_silence_ends_in_the_stated_time(terminal):
    with contextlib.ExitStack() as held:
        device, _, stage = held.enter_context(opened(terminal=terminal, reply_timeout_s=REPLY_S))
        device.fall_silent()
        began = time.monotonic()
        with pytest.raises(TimedOut, match=r"an answer did not come within 0\.4 s"):
            stage.move_to_mm(0.5)
        with pytest.raises(TimedOut):  # leaving tells, too, that rest could not be confirmed
            held.close()
        assert time.monotonic() - began < 4 * REPLY_S + SLACK_S


@pytest.mark.parametrize("terminal", [True, False], ids=["terminal", "tcp"])
@pytest.mark.parametrize("message", [1, 2, 3, 4])
def test_a_port_that_is_pulled_out_is_told_at_once(terminal, message):
    with contextlib.ExitStack() as held:
        device, server, stage = held.enter_context(opened(terminal=terminal, reply_timeout_s=30))
        device.at_message(device.messages + message, server.close)
        began = time.monotonic()
        with pytest.raises(ConnectionLost):
            stage.move_to_mm(0.5)
        with pytest.raises(ConnectionLost):
            held.close()
        assert time.monotonic() - began < SLACK_S


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
    short = {"never arrives": {"settle_timeout_s": 0.2}}
    short |= {name: {"reply_timeout_s": REPLY_S} for name in ("silence", "late", "broken off")}
    for message in rng.sample(range(1, 20), 2 if fault in short else 6):
        with contextlib.ExitStack() as held:
            device, server, stage = held.enter_context(opened(**short.get(fault, {})))
            device.at_message(device.messages + message, lambda d=device, s=server: FAULTS[fault](d, s))
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


def test_a_refusal_names_the_device_s_reason():
    with opened() as (device, _, stage):
        device.answer(b"/1 1 set limit.max 110000")  # after the driver has asked for it
        with pytest.raises(Rejected, match="BADDATA") as error:
            stage.move_to_mm(1.0)
        assert error.value.code == "BADDATA"
        stage.move_to_mm(0.1)


def test_leaving_stops_what_moves():
    model = StageModel(travel=200_000, start=ZERO, maxspeed=20_000, accel=5000)
    for leave in (None, KeyboardInterrupt):
        with contextlib.suppress(KeyboardInterrupt), opened(model, homed=False) as (device, _, _):
            device.answer(b"/1 1 home")
            assert device.moves
            if leave:
                raise leave
        assert not device.moves
        assert device.position > 0


def test_an_interrupt_by_a_person_stops_the_stage(monkeypatch):
    model = StageModel(travel=200_000, start=ZERO, maxspeed=20_000, accel=5000)

    def interrupt(seconds: float) -> None:
        raise KeyboardInterrupt

    with contextlib.suppress(KeyboardInterrupt), opened(model, homed=False) as (device, _, stage):
        commands = heard(device)
        with monkeypatch.context() as patched:
            patched.setattr("greenough.instrument.zaber_stage.time.sleep", interrupt)
            with contextlib.suppress(KeyboardInterrupt):
                stage.home()
        assert ["stop"] in commands


def test_a_stage_found_moving_is_stopped_on_connecting():
    device = ZaberDevice(StageModel(travel=200_000, start=ZERO, maxspeed=20_000, accel=5000))
    device.answer(b"/1 1 home")
    with LineServer(device) as server, ZaberStage(options(server.terminal), (-1.6, 1.6)):
        assert not device.moves
        assert device.position > 0


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
        with contextlib.suppress(DeviceError), opened(reply_timeout_s=REPLY_S) as (device, server, stage):
            if fault:
                fault(device, server)
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
