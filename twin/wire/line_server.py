"""Puts a device that answers lines by lines on a pseudo-terminal and on TCP, as a serial port and its server would be.

One thread serves all ports. Everything is bounded: the length of a line, the number of clients, what waits for a client
that does not read; whoever exceeds it is disconnected, or on the pseudo-terminal loses what does not fit.
"""

import contextlib
import os
import selectors
import socket
import threading
import tty
from collections.abc import Callable
from types import TracebackType
from typing import Protocol, Self

from greenough.instrument.errors import InputError
from greenough.instrument.zaber_messages import LineBuffer

from .loopback import check_loopback

_CHUNK = 4096
_CLIENTS = 4
_WAITING = 65_536  # bytes for a client that does not read
_TICK_S = 0.01


class LineDevice(Protocol):
    """What a server needs of a device."""

    @property
    def moves(self) -> bool:
        """Whether something will happen by itself."""
        ...

    def answer(self, line: bytes) -> list[bytes]: ...

    def tick(self) -> list[bytes]:
        """Let what is due happen, and return what is sent unasked."""
        ...


class _Port:
    """One end of a wire: what has come and is no line yet, what goes out and has not been taken."""

    def __init__(self, number: int, read: Callable[[], bytes], write: Callable[[bytes], int], lossy: bool):
        self.number = number
        self.read, self.write, self.lossy = read, write, lossy
        self.lines = LineBuffer()
        self.waiting = bytearray()

    def send(self, data: bytes) -> bool:
        """Send what is taken at once; False where the client is to be disconnected."""
        self.waiting += data
        try:
            while self.waiting:
                del self.waiting[: self.write(bytes(self.waiting[:_CHUNK]))]
        except BlockingIOError:
            pass
        except OSError:
            self.waiting.clear()
            return self.lossy
        if self.lossy and len(self.waiting) > _WAITING:
            self.waiting.clear()
        return len(self.waiting) <= _WAITING


class LineServer:
    """Serves ``device`` as long as the context is open; ``close`` leaves no thread, socket or terminal behind.

    Parameters
    ----------
    device : LineDevice
    host, port : str, int
        Address to listen on; port 0 is any that is free.
    allow_remote : bool
        Whether it may be another than of loopback.

    Raises
    ------
    InputError
        When ``host`` is not allowed, or the port is taken.
    """

    def __init__(self, device: LineDevice, host: str = "127.0.0.1", port: int = 0, allow_remote: bool = False):
        check_loopback(host, allow_remote)
        self._device = device
        self._closing = False
        self._selector = selectors.DefaultSelector()
        self._clients: dict[int, socket.socket] = {}
        self._ports: dict[int, _Port] = {}
        with contextlib.ExitStack() as opened:
            opened.callback(self._selector.close)
            family = socket.AF_INET6 if ":" in host else socket.AF_INET
            self._listener = opened.enter_context(socket.socket(family, socket.SOCK_STREAM))
            self._listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                self._listener.bind((host, port))
            except OSError as error:
                raise InputError(
                    f"the emulated device cannot listen on {host} port {port} ({(error.strerror or '').lower()}): end "
                    "what listens there, or give another port"
                ) from None
            self._listener.listen(_CLIENTS)
            self._listener.setblocking(False)
            self._wake, self._woken = socket.socketpair()
            opened.enter_context(self._wake)
            opened.enter_context(self._woken)
            self._master, self._slave = os.openpty()
            opened.callback(os.close, self._slave)
            opened.callback(os.close, self._master)
            tty.setraw(self._slave)  # no echo, no line editing
            os.set_blocking(self._master, False)
            self._selector.register(self._listener, selectors.EVENT_READ)
            self._selector.register(self._woken, selectors.EVENT_READ)
            self._add(_Port(self._master, self._read_terminal, self._write_terminal, lossy=True))
            self.host, self.tcp_port = self._listener.getsockname()[:2]
            self.terminal = os.ttyname(self._slave)
            self._opened = opened.pop_all()
        self._thread = threading.Thread(target=self._serve, name=f"line server {self.terminal}", daemon=True)
        self._thread.start()

    @property
    def url(self) -> str:
        """The TCP port as pyserial names it."""
        return f"socket://{f'[{self.host}]' if ':' in self.host else self.host}:{self.tcp_port}"

    def close(self) -> None:
        """Close every port, to a connected client as if it were pulled out; may be called again, and by the device."""
        self._closing = True
        if self._thread.is_alive():
            with contextlib.suppress(OSError):
                self._wake.send(b"\0")
            if self._thread is not threading.current_thread():
                self._thread.join()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def _serve(self) -> None:
        try:
            while True:
                events = self._selector.select(_TICK_S if self._device.moves else None)
                ready = [key.fd for key, event in events if event & selectors.EVENT_READ]
                if self._woken.fileno() in ready:
                    return
                unasked = b"".join(self._device.tick())
                for port in list(self._ports.values()) if unasked else ():
                    self._send(port, unasked)
                for key, event in events:
                    if event & selectors.EVENT_WRITE and key.fd in self._ports:
                        self._send(self._ports[key.fd], b"")
                for number in ready:
                    if number == self._listener.fileno():
                        self._accept()
                    elif number in self._ports:
                        self._exchange(self._ports[number])
        finally:
            for client in self._clients.values():
                client.close()
            self._opened.close()

    def _accept(self) -> None:
        try:
            client, _ = self._listener.accept()
        except OSError:
            return  # the client has left already
        if len(self._clients) >= _CLIENTS:
            client.close()
            return
        client.setblocking(False)
        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._clients[client.fileno()] = client
        self._add(_Port(client.fileno(), lambda: client.recv(_CHUNK), client.send, lossy=False))

    def _add(self, port: _Port) -> None:
        self._ports[port.number] = port
        self._selector.register(port.number, selectors.EVENT_READ)

    def _exchange(self, port: _Port) -> None:
        try:
            received = port.read()
        except BlockingIOError:
            return
        except OSError:
            received = b""
        if not received:
            self._drop(port)
            return
        for line in port.lines.feed(received):
            answer = b"".join(self._device.answer(line))
            if answer and port.number in self._ports:
                self._send(port, answer)

    def _send(self, port: _Port, data: bytes) -> None:
        """Send ``data`` and what waits before it; ask to be woken for the rest."""
        if self._closing:
            return
        if not port.send(data):
            self._drop(port)
            return
        awaited = selectors.EVENT_READ | (selectors.EVENT_WRITE if port.waiting else 0)
        if self._selector.get_key(port.number).events != awaited:
            self._selector.modify(port.number, awaited)

    def _drop(self, port: _Port) -> None:
        if port.number in self._clients:
            self._selector.unregister(port.number)
            del self._ports[port.number]
            self._clients.pop(port.number).close()

    def _read_terminal(self) -> bytes:
        return os.read(self._master, _CHUNK)

    def _write_terminal(self, data: bytes) -> int:
        return os.write(self._master, data)
