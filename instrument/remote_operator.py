"""Hands at the other end of a connection: they lay down what they are told, and say that it lies there.

One connection per placement, one line of JSON each way: ``{"place": {...}}`` with the fields of a ``Placement``, then
``{"placed": true}`` or ``{"refused": "a sentence that says why"}``. Nothing else passes.
"""

import json
import logging
import socket
import time
from dataclasses import asdict

from .contract import Placement
from .device_errors import BadReply, ConnectionLost, TimedOut
from .errors import InputError

LONGEST_LINE = 16_384
"""Bytes of a request or a reply, its end included."""

_CONNECT_TIMEOUT_S = 5.0
_REMEDY = "start the bench that operator.address names (greenough serve) and run again"

_wire = logging.getLogger(__name__)


class RemoteOperator:
    """An operator who is reached at ``(host, port)`` and has ``timeout_s`` for each part."""

    def __init__(self, address: tuple[str, int], timeout_s: float):
        self._address, self._timeout_s = address, timeout_s
        self._name = "operator at {}:{}".format(*address)

    def place(self, placement: Placement) -> None:
        """Have ``placement`` laid down.

        Raises
        ------
        InputError
            When the other end refuses: its own words.
        DeviceError
            ConnectionLost, TimedOut or BadReply. What lies under the microscope is then not known.
        """
        command = f"place {placement.part}"
        request = json.dumps({"place": asdict(placement)}).encode() + b"\n"
        if len(request) > LONGEST_LINE:
            raise InputError(f"the name of the part is too long to be sent: {placement.part[:60]}...; shorten its path")
        try:
            with socket.create_connection(self._address, _CONNECT_TIMEOUT_S) as connection:
                connection.settimeout(self._timeout_s)
                _wire.debug("%s > %s", self._name, request)
                deadline = time.monotonic() + self._timeout_s
                connection.sendall(request)
                reply = _read_line(connection, deadline)
                _wire.debug("%s < %s", self._name, reply)
        except TimeoutError:
            raise TimedOut(self._name, command, self._timeout_s, _REMEDY) from None
        except OSError as error:
            reason = (error.strerror or type(error).__name__).lower()
            raise ConnectionLost(self._name, command, reason, _REMEDY) from None
        if not reply.endswith(b"\n"):
            raise ConnectionLost(self._name, command, "it was closed before an answer", _REMEDY)
        self._understand(command, reply)

    def _understand(self, command: str, reply: bytes) -> None:
        try:
            answer = json.loads(reply)
        except ValueError:  # not JSON, or not even text
            answer = None
        match answer:
            case {"placed": True}:
                return
            case {"refused": str(reason)}:
                raise InputError(reason)
        raise BadReply(self._name, command, reply, "no answer to a placement", _REMEDY)


def _read_line(connection: socket.socket, deadline: float) -> bytes:
    """A line with its end; without where the other end closes before or the line is too long.

    TimeoutError at ``deadline``, however the bytes trickle in.
    """
    line = b""
    while b"\n" not in line and len(line) < LONGEST_LINE:
        left_s = deadline - time.monotonic()
        if left_s <= 0:
            raise TimeoutError
        connection.settimeout(left_s)
        received = connection.recv(LONGEST_LINE - len(line))
        if not received:
            break
        line += received
    return line.partition(b"\n")[0] + b"\n" if b"\n" in line else line
