"""Devices on a terminal and on TCP are reachable from this machine alone, bounded, and gone without a trace."""

import os
import random
import socket
import threading

import pytest

from greenough.instrument.errors import InputError
from greenough.twin.wire.line_server import LineServer
from greenough.twin.wire.zaber import StageModel, ZaberDevice

STATUS, REPLY = b"/1 1 07\n", b"@01 1 07 OK IDLE WR 0\r\n"


@pytest.fixture
def server():
    with LineServer(ZaberDevice(StageModel(instant=True))) as opened:
        yield opened


def connect(server: LineServer) -> socket.socket:
    client = socket.create_connection((server.host, server.tcp_port), timeout=60)
    return client


def receive(client: socket.socket, size: int) -> bytes:
    received = b""
    while len(received) < size and (part := client.recv(size - len(received))):
        received += part
    return received


def test_both_ports_answer_byte_for_byte(server):
    terminal = os.open(server.terminal, os.O_RDWR | os.O_NOCTTY)
    with connect(server) as client:
        client.sendall(STATUS)
        assert receive(client, len(REPLY)) == REPLY
        os.write(terminal, STATUS)
        received = b""
        while len(received) < len(REPLY):
            received += os.read(terminal, 100)
        assert received == REPLY  # no echo, no changed line ends
    os.close(terminal)


@pytest.mark.parametrize("host", ["0.0.0.0", "192.0.2.1", "::", "example.org"])
def test_nothing_but_loopback_is_served_unless_told(host):
    with pytest.raises(InputError):
        LineServer(ZaberDevice(), host)


def test_another_address_can_be_allowed():
    with LineServer(ZaberDevice(), "0.0.0.0", allow_remote=True) as server:
        assert server.host == "0.0.0.0"


def test_nothing_is_left_after_closing():
    with LineServer(ZaberDevice()), LineServer(ZaberDevice()):
        pass  # what is loaded once is loaded now
    threads, files = threading.active_count(), set(os.listdir("/proc/self/fd"))
    for _ in range(5):
        server = LineServer(ZaberDevice())
        with connect(server) as client, connect(server):
            client.sendall(STATUS)
            assert receive(client, len(REPLY)) == REPLY
            assert set(os.listdir("/proc/self/fd")) > files
            server.close()
            assert client.recv(1) == b""
        server.close()
        assert not os.path.exists(server.terminal)
    assert threading.active_count() == threads
    assert set(os.listdir("/proc/self/fd")) == files


def test_a_port_can_be_pulled_out_by_the_device_before_it_answers():
    device = ZaberDevice()
    with LineServer(device) as server, connect(server) as client:
        device.at_message(1, server.close)
        client.sendall(STATUS)
        assert client.recv(100) == b""


def test_what_is_due_happens_without_being_asked():
    device = ZaberDevice(StageModel(start=0, maxspeed=16_384, accel=0))
    with LineServer(device) as server, connect(server) as client:
        for command in (b"/1 set comm.alert 1\n", b"/1 1 move abs 1000\n"):
            client.sendall(command)
        replies = b""
        while b"!01 1 IDLE WR\r\n" not in replies:
            replies += client.recv(100)
        assert device.position == 1000


def test_only_so_many_clients_are_served(server):
    clients = [connect(server) for _ in range(5)]
    for client in clients[:4]:
        client.sendall(STATUS)
        assert receive(client, len(REPLY)) == REPLY
    assert clients[4].recv(1) == b""
    for client in clients:
        client.close()


def test_a_client_that_floods_and_never_reads_is_dropped_and_others_are_served(server):
    with connect(server) as flood, connect(server) as other:
        flood.settimeout(0.2)
        with pytest.raises((TimeoutError, ConnectionError)):  # nothing more is taken, or it is disconnected
            flood.sendall(STATUS * 1_000_000)
        other.sendall(STATUS)
        assert receive(other, len(REPLY)) == REPLY


@pytest.mark.parametrize("seed", [1, 2])
def test_bytes_at_random_do_not_stop_it(server, seed):
    rng = random.Random(seed)
    with connect(server) as client:
        for _ in range(200):
            client.sendall(rng.randbytes(rng.randrange(2000)).replace(b"/", b""))
        client.sendall(b"\n" + STATUS)
        assert receive(client, len(REPLY)) == REPLY
