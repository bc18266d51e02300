"""Placements come in as they were sent, and whatever else comes does no harm."""

import json
import random
import socket
import threading
import tracemalloc
from dataclasses import asdict

import pytest

from greenough.instrument.contract import BLANK, Placement
from greenough.instrument.device_errors import BadReply, ConnectionLost, TimedOut
from greenough.instrument.errors import InputError
from greenough.instrument.remote_operator import LONGEST_LINE, RemoteOperator
from greenough.twin.wire.placements import PlacementServer, answer

pytestmark = pytest.mark.wire

MESH = Placement("part.stl", unit="um", pose_mm_deg=(1.5, -0.25, 0.0, 0.0, 2.0, 1e-3), material="metal")


@pytest.mark.parametrize("placement", [Placement("coin"), Placement("board", 3), Placement("board", face=BLANK), MESH])
def test_a_placement_arrives_as_it_was_sent(placement):
    placed = []
    with PlacementServer(placed.append) as server:
        RemoteOperator(("127.0.0.1", server.port), 5.0).place(placement)
    assert placed == [placement]


def test_a_refusal_comes_back_in_its_own_words():
    def refuse(placement):
        raise InputError("unknown sample 'µ'; choose one of coin")

    with PlacementServer(refuse) as server, pytest.raises(InputError, match="unknown sample 'µ'; choose one of coin"):
        RemoteOperator(("127.0.0.1", server.port), 5.0).place(Placement("µ"))


def test_a_client_that_says_nothing_holds_nobody_up_for_long():
    placed = []
    with PlacementServer(placed.append) as server:
        silent = socket.create_connection(("127.0.0.1", server.port))
        RemoteOperator(("127.0.0.1", server.port), 30.0).place(Placement("coin"))
        silent.close()
    assert placed == [Placement("coin")]


@pytest.mark.parametrize("host", ["0.0.0.0", "192.0.2.7", "::"])
def test_only_loopback_is_listened_on(host):
    with pytest.raises(InputError, match="other machines"):
        PlacementServer(lambda placement: None, host)


def test_nothing_is_left_after_close():
    threads = set(threading.enumerate())
    with PlacementServer(lambda placement: None) as server:
        port = server.port
    assert set(threading.enumerate()) == threads
    with pytest.raises(ConnectionLost, match=rf"operator at 127.0.0.1:{port}: place coin: no connection"):
        RemoteOperator(("127.0.0.1", port), 1.0).place(Placement("coin"))


def _mutated(line: bytes, rng: random.Random) -> bytes:
    data = bytearray(line)
    for _ in range(rng.randrange(1, 6)):
        where = rng.randrange(len(data) + 1)
        match rng.randrange(3):
            case 0:
                data[where : where + rng.randrange(4)] = b""
            case 1:
                data[where:where] = rng.randbytes(rng.randrange(1, 4))
            case _:
                data[where : where + 1] = rng.choice(
                    [b"{", b"}", b"[", b'"', b"\\u", b"1e999", b"NaN", b"null", b"\xff"]
                )
    return bytes(data)


@pytest.mark.slow
def test_fuzzed_requests_are_answered_by_one_line_and_never_place_what_was_not_asked():
    rng = random.Random(7)
    good = [json.dumps({"place": asdict(placement)}).encode() for placement in (Placement("coin"), MESH)]
    placed = []
    tracemalloc.start()
    try:
        for number in range(100_000):
            line = rng.randbytes(rng.randrange(80)) if number % 4 == 0 else _mutated(rng.choice(good), rng)
            placed.clear()
            reply = answer(line, placed.append)
            assert reply.endswith(b"\n")
            assert reply.count(b"\n") == 1
            assert len(reply) <= LONGEST_LINE
            assert (json.loads(reply) == {"placed": True}) == bool(placed)
        grown, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert grown < 2_000_000


def test_deeply_nested_requests_are_refused():
    for line in (b"[" * LONGEST_LINE, b'{"place":' * 1000 + b"1" + b"}" * 1000):
        assert set(json.loads(answer(line, lambda placement: None))) == {"refused"}


def test_fuzzed_replies_are_typed_errors():
    rng = random.Random(8)
    operator = RemoteOperator(("127.0.0.1", 9), 1.0)
    good = [b'{"placed": true}\n', b'{"refused": "no sample of that name"}\n']
    for number in range(100_000):
        reply = rng.randbytes(rng.randrange(60)) if number % 4 == 0 else _mutated(rng.choice(good), rng)
        raised: InputError | None = None
        try:
            operator._understand("place coin", reply)
        except InputError as error:
            raised = error
        if isinstance(raised, BadReply):
            assert raised.device == "operator at 127.0.0.1:9"
        elif raised is not None:
            assert json.loads(reply)["refused"] == str(raised)
        else:
            assert json.loads(reply)["placed"] is True


@pytest.mark.parametrize("reply", [b"", b"{", b'{"placed": true}'])
def test_an_answer_that_is_cut_off_is_a_lost_connection(reply):
    with _one_reply(reply) as port, pytest.raises(ConnectionLost, match="before an answer"):
        RemoteOperator(("127.0.0.1", port), 5.0).place(Placement("coin"))


def test_silence_is_an_error_within_the_stated_time():
    with socket.create_server(("127.0.0.1", 0)) as listener, pytest.raises(TimedOut, match=r"within 0\.2 s"):
        RemoteOperator(listener.getsockname(), 0.2).place(Placement("coin"))


def test_a_name_that_is_too_long_is_refused_before_anything_is_sent():
    with pytest.raises(InputError, match="too long"):
        RemoteOperator(("127.0.0.1", 9), 1.0).place(Placement("x" * LONGEST_LINE))


class _one_reply:
    """A server that answers one client with these bytes and hangs up."""

    def __init__(self, reply: bytes):
        self._reply = reply

    def __enter__(self) -> int:
        self._listener = socket.create_server(("127.0.0.1", 0))
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()
        return self._listener.getsockname()[1]

    def _serve(self) -> None:
        client, _ = self._listener.accept()
        with client:
            client.recv(LONGEST_LINE)
            client.sendall(self._reply)

    def __exit__(self, *exc: object) -> None:
        self._thread.join()
        self._listener.close()
