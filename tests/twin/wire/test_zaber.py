"""The emulated stage behaves as firmware does: the vendor's own library takes it for one of theirs."""

import random
import tracemalloc

import pytest
from zaber_motion.ascii import Connection
from zaber_motion.exceptions import (
    BadCommandException,
    BadDataException,
    MovementFailedException,
    RequestTimeoutException,
)

from greenough.twin.wire.line_faults import wrong_checksum
from greenough.twin.wire.line_server import LineServer
from greenough.twin.wire.zaber import StageModel, ZaberDevice

pytestmark = pytest.mark.wire

INSTANT = StageModel(instant=True)


class Clock:
    """Seconds that pass when told to."""

    now = 100.0

    def __call__(self) -> float:
        return self.now


def ask(device: ZaberDevice, command: str) -> str:
    """The one reply to a command without checksum, without its end."""
    (reply,) = device.answer(command.encode())
    assert reply.endswith(b"\r\n")
    return reply[:-2].decode()


@pytest.fixture(params=["tcp", "terminal"])
def vendors(request):
    """(device, axis of the vendor's library) over either port."""
    device = ZaberDevice(INSTANT)
    with LineServer(device) as server:
        over_tcp = request.param == "tcp"
        opened = (
            Connection.open_tcp(server.host, server.tcp_port)
            if over_tcp
            else Connection.open_serial_port(server.terminal)
        )
        with opened as connection:
            connection.default_request_timeout = 60_000  # ms
            assert connection.checksum_enabled
            yield device, connection.get_device(1).get_axis(1)


def test_the_vendors_library_homes_moves_and_reads_it(vendors):
    device, axis = vendors
    assert not axis.is_homed()
    assert axis.warnings.get_flags() == {"WR"}
    axis.home()
    assert axis.is_homed()
    assert device.position == 0
    axis.move_absolute(2000)
    axis.move_relative(-500)
    assert axis.get_position() == device.position == 1500
    axis.move_max()
    assert axis.get_position() == INSTANT.travel
    axis.stop()
    assert not axis.is_busy()
    assert axis.settings.get("maxspeed") == INSTANT.maxspeed


def test_the_vendors_library_understands_its_refusals_and_faults(vendors):
    device, axis = vendors
    with pytest.raises(BadCommandException):
        axis.generic_command("sing")
    with pytest.raises(BadDataException):
        axis.generic_command("move abs -1")
    device.stall()
    with pytest.raises(MovementFailedException, match="FS"):
        axis.move_absolute(9000)
    device.press_emergency_stop()
    assert "FH" in axis.warnings.get_flags()


def test_the_vendors_library_joins_the_pieces_of_a_long_reply():
    words = "one two three four five six seven eight nine ten"
    device = ZaberDevice(StageModel(packet=45))
    assert len(device.answer(f"/1 0 09 tools echo {words}".encode())) > 2
    with LineServer(device) as server, Connection.open_tcp(server.host, server.tcp_port) as connection:
        assert connection.get_device(1).generic_command(f"tools echo {words}").data == words


def test_the_vendors_library_refuses_a_wrong_checksum(vendors):
    device, axis = vendors
    axis.device.connection.default_request_timeout = 500
    device.spoil(wrong_checksum)
    with pytest.raises(RequestTimeoutException):
        axis.get_position()


def test_what_the_vendor_sent_is_answered_as_recorded():
    """Requests and the reply are those that the vendor's library was seen to exchange with a device."""
    device = ZaberDevice(INSTANT)
    assert device.answer(b"/1 1 01 home:34") == [b"@01 1 01 OK BUSY WR 0:97\r\n"]
    assert device.answer(b"/1 1 10 move abs 2000:EE") == [b"@01 1 10 OK BUSY -- 0:E6\r\n"]
    assert device.answer(b"/1 1 18 get pos:23") == [b"@01 1 18 OK IDLE -- 2000:71\r\n"]


@pytest.mark.parametrize(
    ("command", "reply"),
    [
        ("/", "@01 0 OK IDLE WR 0"),
        ("/1", "@01 0 OK IDLE WR 0"),
        ("/1 1 07", "@01 1 07 OK IDLE WR 0"),
        ("/get pos", "@01 0 OK IDLE WR 0"),
        ("/1 get limit.max", "@01 0 OK IDLE WR 1066667"),
        ("/1 1 get version", "@01 1 OK IDLE WR 7.38"),
        ("/1 1 5 warnings", "@01 1 05 OK IDLE WR 01 WR"),
        ("/1 2 get pos", "@01 2 RJ IDLE WR BADAXIS"),
        ("/1 1 100 get pos", "@01 1 00 RJ IDLE WR BADMESSAGEID"),
        ("/1 1 sing", "@01 1 RJ IDLE WR BADCOMMAND"),
        ("/1 1 get song", "@01 1 RJ IDLE WR BADCOMMAND"),
        ("/1 1 move abs", "@01 1 RJ IDLE WR BADDATA"),
        ("/1 1 move abs up", "@01 1 RJ IDLE WR BADDATA"),
        ("/1 1 move abs 1066668", "@01 1 RJ IDLE WR BADDATA"),
        ("/1 1 move rel -1", "@01 1 RJ IDLE WR BADDATA"),
        ("/1 1 set maxspeed 0", "@01 1 RJ IDLE WR BADDATA"),
        ("noise/1 1 07", "@01 1 07 OK IDLE WR 0"),
    ],
)
def test_replies(command, reply):
    assert ask(ZaberDevice(INSTANT), command) == reply


@pytest.mark.parametrize(
    "line",
    [b"", b"1 1 home", b"/2 1 home", b"/1 1 01 home:35", b"/1 1 01 home:3", b"/1 1 h\xf6me", b"/1 " + b"x" * 200],
)
def test_what_firmware_ignores_changes_nothing(line):
    device = ZaberDevice(INSTANT)
    assert device.answer(line) == []
    assert ask(device, "/1 1 warnings") == "@01 1 OK IDLE WR 01 WR"


def test_checksums_can_be_asked_for_always():
    plain = ZaberDevice(StageModel(mirrors_checksums=False))
    assert plain.answer(b"/1 1 18 get pos:23") == [b"@01 1 18 OK IDLE WR 0\r\n"]
    plain.answer(b"/1 set comm.checksum 1")
    content = b"01 1 18 OK IDLE WR 0"
    assert plain.answer(b"/1 1 18 get pos") == [b"@%s:%02X\r\n" % (content, -sum(content) % 256)]


def test_it_moves_in_its_own_time_and_tells_where_it_is():
    clock, told = Clock(), []
    device = ZaberDevice(StageModel(start=0, maxspeed=16_384, accel=0), told.append, clock)  # 10 000 microsteps/s
    ask(device, "/1 1 home")
    assert ask(device, "/1 1 move abs 20000") == "@01 1 OK BUSY -- 0"
    clock.now += 0.5
    assert ask(device, "/1 1 get pos") == "@01 1 OK BUSY -- 5000"
    assert told[-1] == pytest.approx(device.position) == pytest.approx(5000)
    ask(device, "/1 1 stop")
    clock.now += 5
    assert ask(device, "/1 1 get pos") == "@01 1 OK IDLE NI 5000"
    ask(device, "/1 1 move abs 0")
    clock.now += 0.51
    assert ask(device, "/1 1") == "@01 1 OK IDLE -- 0"
    assert told[-1] == 0


def test_counts_mean_nothing_before_it_is_homed():
    clock = Clock()
    device = ZaberDevice(StageModel(start=70_000), clock=clock)
    ask(device, "/1 1 move abs 1000")
    clock.now += 10
    assert ask(device, "/1 1 get pos") == "@01 1 OK IDLE WR 1000"
    assert device.position == 71_000
    ask(device, "/1 1 home")
    clock.now += 10
    assert ask(device, "/1 1 get pos") == "@01 1 OK IDLE -- 0"
    assert device.position == 0


def test_the_end_of_a_motion_is_alerted_where_hosts_want_it():
    clock = Clock()
    device = ZaberDevice(clock=clock)
    ask(device, "/1 set comm.alert 1")
    ask(device, "/1 1 home")
    assert device.moves
    assert device.tick() == []
    clock.now += 60
    assert not device.moves
    assert device.tick() == [b"!01 1 IDLE --\r\n"]
    assert device.tick() == []


def test_faults_end_as_firmware_lets_them_end():
    device = ZaberDevice(INSTANT)
    ask(device, "/1 1 home")
    device.press_emergency_stop()
    assert ask(device, "/1 1 move abs 5") == "@01 1 RJ IDLE FH DRIVERDISABLED"
    assert ask(device, "/1 1 driver enable") == "@01 1 RJ IDLE FH AGAIN"
    device.release_emergency_stop()
    assert ask(device, "/1 1 move abs 5") == "@01 1 RJ IDLE FH DRIVERDISABLED"
    assert ask(device, "/1 1 driver enable") == "@01 1 OK IDLE -- 0"
    device.stall()
    ask(device, "/1 1 move abs 100")
    assert ask(device, "/1 1 get pos") == "@01 1 OK IDLE FS 50"
    assert ask(device, "/1 1 warnings clear") == "@01 1 OK IDLE -- 01 FS"
    device.hang()
    ask(device, "/1 1 move abs 1000")
    assert ask(device, "/1 1") == "@01 1 OK BUSY -- 0"
    ask(device, "/1 1 stop")
    assert ask(device, "/1 1") == "@01 1 OK IDLE NI 0"
    device.turn_knob(7)
    assert ask(device, "/1 1 warnings") == "@01 1 OK IDLE NC 02 NC NI"
    device.switch_off_and_on()
    assert ask(device, "/1 1 warnings") == "@01 1 OK IDLE WR 01 WR"


def test_a_fault_comes_with_the_message_it_was_meant_for():
    device = ZaberDevice(INSTANT)
    device.at_message(3, device.fall_silent)
    device.at_message(4, device.speak)
    assert [len(device.answer(b"/1 1 get pos")) for _ in range(5)] == [1, 1, 0, 1, 1]


@pytest.mark.parametrize("seed", [1, 2])
def test_no_line_does_more_than_be_refused(seed):
    rng = random.Random(seed)
    device = ZaberDevice(INSTANT)
    good = [
        b"/1 1 01 home:34",
        b"/1 1 10 move abs 2000:EE",
        b"/1 1 move rel 5",
        b"/1 1 stop",
        b"/1 1 set limit.max 500000",
        b"/1 set comm.alert 1",
        b"/1 1 warnings clear",
        b"/1 tools echo one two",
        b"/1 1 driver disable",
        b"/1 1 driver enable",
    ]
    refused = obeyed = 0
    for number in range(60_000):
        if number == 58_000:
            tracemalloc.start()
        line = bytearray(rng.choice(good))
        for _ in range(rng.randrange(3)):
            place = rng.randrange(len(line))
            line[place : place + rng.randrange(3)] = rng.randbytes(rng.randrange(4))
            line = line or bytearray(b"/")
        if rng.random() < 0.1:
            line = bytearray(rng.randbytes(rng.randrange(300)))
        for reply in device.answer(bytes(line)):
            assert len(reply) < 200
            obeyed += b" OK " in reply
            refused += b" RJ " in reply
    held, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert held < 20_000  # ten bytes for each of the last messages
    assert obeyed > 5000
    assert refused > 5000
