"""The driver of the LightCrafter against the emulated one, over loopback, and what it does when the wire fails."""

import os
import random
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
import pytest

from greenough.instrument.device_errors import BadReply, ConnectionLost, DeviceError, Rejected, TimedOut
from greenough.instrument.errors import InputError
from greenough.instrument.lightcrafter import LightCrafter, LightCrafterSettings, in_batches
from greenough.instrument.lightcrafter_commands import Command, Led, Trigger, TriggerOut
from greenough.instrument.lightcrafter_packets import Packet, PacketType, encode_packet
from greenough.twin.wire.lightcrafter import MAX_CLIENTS, Fault, Faults, LightCrafterServer, at_request
from greenough.twin.wire.lightcrafter_device import LightCrafterDevice

pytestmark = pytest.mark.wire

GOLDEN = Path(__file__).parents[2] / "instrument" / "lightcrafter_packets.txt"
UNUSED = {"get mode *", "static mode *", "test pattern 0 *"}  # by the driver
PATIENT_S = 60.0
SHAPE = (684, 608)


def patterns(count: int, seed: int = 6) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (count, *SHAPE), dtype=np.uint8)


def settings_for(server: LightCrafterServer, **changes) -> LightCrafterSettings:
    defaults = {"host": "127.0.0.1", "port": server.port, "timeout_s": PATIENT_S, "busy_s": PATIENT_S}
    return LightCrafterSettings(**(defaults | changes))


@contextmanager
def emulated(faults: Faults = lambda request: Fault.NONE) -> Iterator[tuple[LightCrafterServer, list[Packet]]]:
    """A server that keeps the requests it got."""
    requests: list[Packet] = []

    def recording(request: Packet) -> Fault:
        requests.append(request)
        return faults(request)

    with LightCrafterServer(LightCrafterDevice(), faults=recording) as server:
        yield server, requests


def golden() -> dict[str, bytes]:
    lines = GOLDEN.read_text().splitlines()
    return {line[:21].strip(): bytes.fromhex(line[21:]) for line in lines if not line.startswith("#")}


def test_24_patterns_are_shown_as_two_uploads_of_12() -> None:
    sent = patterns(24)
    with emulated() as (server, requests), LightCrafter(settings_for(server)) as projector:
        seen = []
        for batch in in_batches(sent):
            projector.upload(batch)
            assert not server.device.lit
            projector.start()
            for index in range(len(batch)):
                if index:
                    projector.advance()
                shown = server.device.shown
                assert shown is not None
                seen.append(shown.patterns[shown.index])
            projector.stop()
        np.testing.assert_array_equal(seen, sent)
        uploads = [r for r in requests if r.command == Command.PATTERN]
        assert len(uploads) == 24 * 7
        assert [r.payload[0] for r in uploads if r.part == 1] == [*range(12), *range(12)]


def test_a_pattern_is_shown_by_its_number() -> None:
    sent = patterns(3)
    with emulated() as (server, _), LightCrafter(settings_for(server)) as projector:
        projector.upload(sent)
        for index in (2, 0, 1, 1):
            projector.show(index)
            shown = server.device.shown
            assert shown is not None
            np.testing.assert_array_equal(shown.patterns[shown.index], sent[index])
        projector.stop()
        assert not server.device.lit


def test_the_driver_sends_what_public_software_sends() -> None:
    with emulated() as (server, requests):
        by_command = settings_for(server, led=Led.RED, short_axis_flip=True)
        with LightCrafter(by_command) as projector:
            assert projector.versions.dm365.startswith("DM365")
            assert projector.led_current() == (255, 255, 255)
            projector.set_timing(16_666)
            projector.upload(patterns(12))
            projector.start()
            projector.advance()
            projector.show(5)
        with LightCrafter(settings_for(server, trigger=Trigger.AUTO, repeat=False)) as projector:
            projector.set_timing(33_333)
            assert projector.period_us == 33_583
            projector.upload(patterns(12))
        sent = {encode_packet(request) for request in requests}
    packets = golden()
    assert {name for name, data in packets.items() if data not in sent} == UNUSED


def test_the_grey_scale_is_never_bent_by_another_display_mode() -> None:
    with emulated() as (server, requests):
        with LightCrafter(settings_for(server)) as projector:
            projector.upload(patterns(1))
            projector.start()
        modes = {r.payload for r in requests if r.type == PacketType.WRITE and r.command == Command.DISPLAY_MODE}
        assert modes == {b"\4"}
        assert all(r.command in tuple(Command) for r in requests)


def test_connecting_lights_nothing_and_puts_out_what_was_lit() -> None:
    with emulated() as (server, _):
        assert server.device.lit  # its own picture
        with LightCrafter(settings_for(server)) as projector:
            assert not server.device.lit
            projector.upload(patterns(1))
            projector.start()
            projector._link.close()  # as if the process had been killed
            projector._dark = True
        assert server.device.lit
        with LightCrafter(settings_for(server)):
            assert not server.device.lit


@pytest.mark.parametrize("error", [KeyboardInterrupt, ValueError, None])
def test_leaving_makes_it_dark(error: type[BaseException] | None) -> None:
    with emulated() as (server, _):
        try:
            with LightCrafter(settings_for(server)) as projector:
                projector.upload(patterns(1))
                projector.start()
                assert server.device.lit
                if error:
                    raise error
        except (KeyboardInterrupt, ValueError):
            pass
        assert not server.device.lit


def test_an_interrupt_in_the_middle_of_an_exchange_leaves_it_dark(monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt() -> None:
        raise KeyboardInterrupt

    with emulated() as (server, _), LightCrafter(settings_for(server)) as projector:
        projector.upload(patterns(1))
        projector.start()
        monkeypatch.setattr(projector._link._reader, "take", interrupt)
        with pytest.raises(KeyboardInterrupt):
            projector.show(0)
        assert not server.device.lit


@pytest.mark.parametrize(
    ("change", "allowed"),
    [
        (lambda p: p.set_timing(8_332), "8333 to 5e\\+06 us"),
        (lambda p: p.set_timing(5_000_001), "8333 to 5e\\+06 us"),
        (lambda p: p.set_timing(float("nan")), "8333 to 5e\\+06 us"),
        (lambda p: p.set_timing(10_000, 9_999), "10000 to"),
        (lambda p: p.set_timing(10_000, 2.0**32), "10000 to"),
        (lambda p: p.set_led_current(255, 256, 0), "green LED .* 0 to 255"),
        (lambda p: p.set_led_current(255, 0, -1), "blue LED .* 0 to 255"),
        (lambda p: p.set_trigger_out(TriggerOut(1, 0, -1, 0)), "delay"),
        (lambda p: p.set_trigger_out(TriggerOut(1, 0, 0, 2**32)), "pulse"),
        (lambda p: p.upload(patterns(13)), "1 to 12"),
        (lambda p: p.upload(patterns(2)[:, 1:]), "684, 608"),
        (lambda p: p.upload(patterns(2).astype(float)), "684, 608"),
        (lambda p: p.show(2), "0 to 1"),
        (lambda p: p.show(-1), "0 to 1"),
    ],
)
def test_what_is_out_of_range_is_refused_before_anything_is_sent(
    change: Callable[[LightCrafter], None], allowed: str
) -> None:
    with emulated() as (server, requests), LightCrafter(settings_for(server)) as projector:
        projector.upload(patterns(2))
        sent, timing = len(requests), (projector.exposure_us, projector.period_us)
        with pytest.raises(InputError, match=allowed) as caught:
            change(projector)
        assert not isinstance(caught.value, DeviceError)
        assert len(requests) == sent
        assert (projector.exposure_us, projector.period_us) == timing


def test_nothing_can_be_shown_before_it_is_uploaded_or_advanced_where_time_does_it() -> None:
    with emulated() as (server, requests), LightCrafter(settings_for(server, trigger=Trigger.AUTO)) as projector:
        sent = len(requests)
        for command in (projector.start, projector.advance, lambda: projector.show(0)):
            with pytest.raises(InputError):
                command()
        assert len(requests) == sent


def test_a_current_beyond_its_limit_is_refused_before_connecting() -> None:
    with pytest.raises(InputError, match="0 to 100"):
        LightCrafter(LightCrafterSettings(led_current=(0, 101, 0), led_current_max=100))


def test_another_exposure_needs_no_other_upload() -> None:
    sent = patterns(2)
    with emulated() as (server, requests), LightCrafter(settings_for(server)) as projector:
        projector.upload(sent)
        for exposure_us in (8_333.0, 20_000.0, 20_000.4):
            projector.set_timing(exposure_us)
            projector.start()
            shown = server.device.shown
            assert shown is not None
            assert shown.sequence.exposure_us == round(exposure_us) == projector.exposure_us
            np.testing.assert_array_equal(shown.patterns, sent)
            projector.stop()
        assert sum(r.command == Command.PATTERN for r in requests) == 2 * 7
        assert sum(r.command == Command.SEQUENCE for r in requests) == 2  # with the upload, and for the second exposure


def test_settings_reach_the_device() -> None:
    out = TriggerOut(enabled=1, falling=1, delay_us=3, pulse_us=500)
    changes = {"led": Led.BLUE, "led_current": (1, 2, 3), "trigger_out": out}
    with emulated() as (server, _), LightCrafter(settings_for(server, **changes)) as projector:
        assert server.device.trigger_out == out
        assert server.device.led_current == (1, 2, 3)
        projector.set_led_current(4, 5, 6)
        assert projector.led_current() == server.device.led_current == (4, 5, 6)
        projector.upload(patterns(1))
        projector.show(0)
        assert server.device.shown is not None
        assert server.device.shown.sequence.led == Led.BLUE


def session(settings: LightCrafterSettings, device: LightCrafterDevice) -> None:
    """Connect, upload, show and step: 20 requests, of which 8 connect and 8 upload. Never a wrong picture."""
    sent = patterns(1)
    with LightCrafter(settings) as projector:
        projector.upload(sent)
        for light in (projector.start, projector.advance, lambda: projector.show(0)):
            light()
            shown = device.shown
            assert shown is not None
            np.testing.assert_array_equal(shown.patterns, sent)
        projector.stop()
        assert not device.lit


REQUESTS = 20
OUTCOMES = {
    Fault.BUSY: (),
    Fault.FAILED: (Rejected,),
    Fault.RESET: (ConnectionLost,),
    Fault.WRONG_CHECKSUM: (BadReply,),
    Fault.TWICE: (BadReply,),
}


@pytest.mark.parametrize("fault", OUTCOMES)
def test_wherever_the_wire_fails_the_error_is_typed_and_the_projector_dark(fault: Fault) -> None:
    errors = []
    for number in range(REQUESTS):
        with emulated(at_request(number, fault)) as (server, requests):
            settings = settings_for(server)
            try:
                session(settings, server.device)
                assert len(requests) == REQUESTS + (fault == Fault.BUSY)
            except DeviceError as error:
                errors.append(error)
            assert not server.device.lit or number == 0  # its own picture, if the very first request is refused
            if number % 6 == 0:
                session(settings, server.device)  # works again
    assert all(isinstance(error, OUTCOMES[fault]) for error in errors)
    assert all("projector at 127.0.0.1:" in str(error) and "run again" in str(error) for error in errors)
    # A refusal to stop what is not running is no failure, and of a last reply the second copy is never read.
    expected = {Fault.BUSY: 0, Fault.FAILED: REQUESTS - 1, Fault.TWICE: REQUESTS - 1}
    assert len(errors) == expected.get(fault, REQUESTS)


@pytest.mark.parametrize(("fault", "number"), [(Fault.SILENCE, 10), (Fault.SILENCE, 17), (Fault.TRUNCATED, 16)])
def test_silence_ends_in_a_timeout_and_in_the_dark(fault: Fault, number: int) -> None:
    with emulated(at_request(number, fault)) as (server, _):
        with pytest.raises(TimedOut, match="within 1 s"):
            session(settings_for(server, timeout_s=1.0), server.device)
        assert not server.device.lit


def test_a_projector_that_never_speaks_again_is_given_up_and_said_to_be_perhaps_lit() -> None:
    with emulated(at_request(17, Fault.SILENCE, count=100)) as (server, _):
        settings = settings_for(server, timeout_s=1.0)
        with pytest.raises(TimedOut, match="see that the projector is dark"):
            session(settings, server.device)


def test_after_a_lost_connection_the_driver_is_entered_again() -> None:
    with emulated(at_request(17, Fault.RESET)) as (server, _):
        projector = LightCrafter(settings_for(server))
        with projector:
            projector.upload(patterns(1))
            projector.start()
            with pytest.raises(ConnectionLost):
                projector.show(0)
            assert not server.device.lit
            with pytest.raises(InputError):
                projector.show(0)
        with projector:
            projector.upload(patterns(1))
            projector.show(0)
            assert server.device.lit
        assert not server.device.lit


def open_files() -> int:
    return len(os.listdir("/proc/self/fd"))


def test_no_thread_and_no_socket_is_left() -> None:
    with emulated():
        pass
    threads, files = threading.active_count(), open_files()
    for number in (0, 9, 17, 100):
        with emulated(at_request(number, Fault.RESET)) as (server, _), suppress(ConnectionLost):
            session(settings_for(server), server.device)
    assert threading.active_count() == threads
    assert open_files() == files


def test_a_server_ends_with_clients_connected_and_they_notice() -> None:
    with LightCrafterServer(LightCrafterDevice()) as server:
        projector = LightCrafter(settings_for(server))
        projector.__enter__()
    with pytest.raises(ConnectionLost):
        projector.led_current()


def test_only_so_many_clients_are_served_and_a_place_is_free_again() -> None:
    with LightCrafterServer(LightCrafterDevice()) as server:
        clients = [socket.create_connection(("127.0.0.1", server.port), PATIENT_S) for _ in range(MAX_CLIENTS)]
        version = encode_packet(Packet(PacketType.READ, Command.DISPLAY_MODE))
        for client in clients:
            client.sendall(version)
            assert client.recv(100)[0] == PacketType.READ_REPLY
        with socket.create_connection(("127.0.0.1", server.port), PATIENT_S) as surplus:
            assert surplus.recv(100) == b""
        for client in clients:
            with client:
                client.shutdown(socket.SHUT_WR)
                assert client.recv(100) == b""  # it has been let go
        session(settings_for(server), server.device)


def test_a_client_that_does_not_read_hinders_nobody() -> None:
    with LightCrafterServer(LightCrafterDevice()) as server:
        with LightCrafter(settings_for(server)) as projector:
            projector.upload(patterns(1))
        with socket.create_connection(("127.0.0.1", server.port), PATIENT_S) as deaf:
            deaf.sendall(500 * encode_packet(Packet(PacketType.READ, Command.PATTERN, b"\0")))
            session(settings_for(server), server.device)


def test_random_bytes_on_the_wire_hinder_nobody() -> None:
    rng = random.Random(7)
    with LightCrafterServer(LightCrafterDevice()) as server:
        for _ in range(20):
            with socket.create_connection(("127.0.0.1", server.port), PATIENT_S) as client:
                client.sendall(rng.randbytes(rng.randrange(3000)))
        session(settings_for(server), server.device)


@pytest.mark.parametrize("host", ["0.0.0.0", "192.168.1.100"])
def test_an_address_that_others_can_reach_is_refused(host: str) -> None:
    with pytest.raises(InputError, match="other machines"):
        LightCrafterServer(LightCrafterDevice(), host)
