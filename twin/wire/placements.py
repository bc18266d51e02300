"""Where an emulated bench is told what to lay under its lenses: placements come in, and nothing else goes out.

The protocol is that of ``greenough.instrument.remote_operator``.
"""

import contextlib
import json
import socketserver
import threading
from collections.abc import Callable
from typing import Any, Self

from pydantic import TypeAdapter, ValidationError

from greenough.instrument.contract import Placement
from greenough.instrument.errors import InputError
from greenough.instrument.remote_operator import LONGEST_LINE

from .loopback import check_loopback

_POLL_S = 0.05
_CLIENT_TIMEOUT_S = 5.0  # for a client to send its line and take the answer

_placement = TypeAdapter(Placement)


def answer(line: bytes, place: Callable[[Placement], None]) -> bytes:
    """What is said to one line: ``place`` is called if it is a placement. Whatever came, the answer is a line."""
    try:
        request: Any = json.loads(line)
        if not isinstance(request, dict) or set(request) != {"place"}:
            raise ValueError
        placement = _placement.validate_json(json.dumps(request["place"]), strict=True)
    except (ValueError, ValidationError, RecursionError):
        return _line({"refused": 'send a line {"place": {...}} with the fields of a placement'})
    try:
        place(placement)
    except InputError as refusal:
        return _line({"refused": str(refusal)})
    return _line({"placed": True})


def _line(reply: dict[str, Any]) -> bytes:
    encoded = json.dumps(reply).encode() + b"\n"
    return encoded if len(encoded) <= LONGEST_LINE else b'{"refused": "it was refused in too many words"}\n'


class PlacementServer:
    """Takes placements, one client after the other, in a thread of its own, from ``with`` to its end.

    Parameters
    ----------
    place : callable of Placement
        Raises InputError for what cannot be placed, which the client is told.
    host, port : str, int
        Where to listen; port 0 is any that is free, see ``port``.
    allow_remote : bool
        Take another address than loopback.

    Raises
    ------
    InputError
        For an address that others can reach, unless ``allow_remote``, and on entering for one that is taken.
    """

    def __init__(
        self,
        place: Callable[[Placement], None],
        host: str = "127.0.0.1",
        port: int = 0,
        allow_remote: bool = False,
    ):
        check_loopback(host, allow_remote)
        self._place, self._address = place, (host, port)

    @property
    def port(self) -> int:
        """The port that is listened on."""
        return self._server.server_address[1]

    def __enter__(self) -> Self:
        place = self._place

        class Handler(socketserver.StreamRequestHandler):
            timeout = _CLIENT_TIMEOUT_S

            def handle(self) -> None:
                with contextlib.suppress(OSError):  # the client is slow or gone: the next one
                    line = self.rfile.readline(LONGEST_LINE)
                    if line:
                        self.wfile.write(answer(line, place))

        class Server(socketserver.TCPServer):
            allow_reuse_address = True

        try:
            self._server = Server(self._address, Handler)
        except OSError as error:
            reason = (error.strerror or "").lower()
            raise InputError(
                f"placements cannot be taken at {self._address[0]}:{self._address[1]} ({reason}): end what listens "
                "there, or give another port"
            ) from None
        self._thread = threading.Thread(target=self._server.serve_forever, args=(_POLL_S,), name="placements")
        self._thread.start()
        return self

    def __exit__(self, *exc: object) -> None:
        self._server.shutdown()
        self._thread.join()
        self._server.server_close()
