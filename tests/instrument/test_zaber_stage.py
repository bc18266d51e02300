"""The driver keeps the contract, and what goes wrong with the stage itself is a typed error, at rest."""

import contextlib
import time

import pytest
from emulated_zaber import INSTANT, MICROSTEP_UM, ZERO, heard, opened, options

from greenough.instrument.device_errors import DeviceError, Fault, Rejected, TimedOut
from greenough.instrument.errors import InputError
from greenough.instrument.zaber_stage import ZaberStage
from greenough.twin.wire.line_server import LineServer
from greenough.twin.wire.zaber import StageModel, ZaberDevice


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
    model = StageModel(travel=200_000, start=ZERO, maxspeed=2000, accel=0)  # homes in 80 s
    moved = []
    with opened(model, homed=False, home_timeout_s=600) as (device, _, stage):

        def press() -> None:
            moved.append(device.moves)
            device.press_emergency_stop()

        device.at_message(device.messages + 12, press)  # while it is asked whether it has arrived
        with pytest.raises(Fault, match="FH"):
            stage.home()
        assert moved == [True]
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
