"""An operator at the other end of a connection that misbehaves."""

import contextlib
import socket
import threading

import pytest

from greenough.instrument.contract import Placement
from greenough.instrument.device_errors import TimedOut
from greenough.instrument.remote_operator import RemoteOperator

WAIT_S, BETWEEN_S = 0.5, 0.02


@pytest.mark.timeout(60)
def test_an_answer_that_trickles_in_does_not_make_a_wait_endless():
    ended = threading.Event()

    def trickle() -> None:
        client, _ = listener.accept()
        with client, contextlib.suppress(ConnectionError):  # who waited has left
            while not ended.wait(BETWEEN_S):
                client.send(b" ")

    with socket.create_server(("127.0.0.1", 0)) as listener:
        thread = threading.Thread(target=trickle)
        thread.start()
        try:
            with pytest.raises(TimedOut, match=r"place coin: an answer did not come within 0\.5 s; start the bench"):
                RemoteOperator(listener.getsockname(), WAIT_S).place(Placement("coin"))
        finally:
            ended.set()
            thread.join()
