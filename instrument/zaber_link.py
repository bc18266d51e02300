"""Asks one Zaber device, over a serial port or TCP, and gets the answer to what was asked or a typed error.

Commands bear ids and checksums, and answers with other ids are left aside, as are alerts and infos: they may come at
any time. Every wait is bounded.
"""

import contextlib
import logging
import random
import termios
import time
from collections.abc import Iterator

import serial

from .device_errors import BadReply, ConnectionLost, Rejected, TimedOut
from .zaber_messages import REJECTIONS, LineBuffer, MalformedMessage, Message, encode_command, parse_message

_log = logging.getLogger(__name__)
_IDS = 100
_LONGEST_REPLY = 16  # messages
_POLL_S = 0.02
_CABLE = "check cable, power and baud rate, close other programs that use the port, and try again"
_AGAIN = "check the cable and try again"


class ZaberLink:
    """An open connection to one device.

    Parameters
    ----------
    url : str
        A port such as ``/dev/ttyUSB0``, or ``socket://host:port``: whatever pyserial's ``serial_for_url`` opens.
    device : int
        The device's number in its chain, from 1.
    baud : int
    reply_timeout_s : float
        How long to wait for an answer.

    Raises
    ------
    ConnectionLost
        When it cannot be opened.
    """

    def __init__(self, url: str, device: int, baud: int, reply_timeout_s: float):
        self.name = f"Zaber stage {device} on {url}"
        self.checked = False  # whether an answer without a checksum is refused
        self._device = device
        self._timeout_s = reply_timeout_s
        self._wire_log = _log.getChild(self.name.replace(".", "_"))
        self._lines = LineBuffer()
        self._received: list[bytes] = []
        self._message_id = random.randrange(_IDS)  # an answer to somebody before us is hardly taken for ours
        with self._losses("open"):
            self._port = serial.serial_for_url(
                url, baudrate=baud, timeout=_POLL_S, write_timeout=reply_timeout_s, exclusive=True
            )
        try:
            with self._losses("open"):
                self._port.reset_input_buffer()
        except BaseException:
            self.close()
            raise

    def ask(self, text: str, axis: int) -> Message:
        """Send a command and wait for its answer, with what infos add to it.

        Parameters
        ----------
        text : str
            Empty to ask for the status alone.
        axis : int
            0 for the device as a whole.

        Raises
        ------
        TimedOut
            When no answer came in time.
        Rejected
            When the device refuses the command.
        BadReply
            When a damaged reply came, or one without a checksum although ``checked``.
        ConnectionLost
            When the port is gone.
        """
        command = text or "status"
        deadline = time.monotonic() + self._timeout_s
        self._lines.clear()  # what began before the question is no answer to it
        self._received.clear()
        self._message_id = (self._message_id + 1) % _IDS
        sent = encode_command(text, self._device, axis, self._message_id)
        self._wire_log.debug("> %s", sent.decode("ascii").rstrip())
        with self._losses(command):
            self._port.write(sent)
        reply = self._next("@", axis, command, deadline)
        data, last = reply.data, reply
        for _ in range(_LONGEST_REPLY):
            if not last.more:
                break
            last = self._next("#", axis, command, deadline)
            data += f" {last.data}"
        else:
            raise BadReply(self.name, command, data.encode(), "no end", _AGAIN)
        if not reply.accepted:
            meaning = REJECTIONS.get(data, "a reason of newer firmware")
            raise Rejected(self.name, command, data, meaning, "see the protocol's manual about this command")
        return Message(
            reply.kind, reply.device, axis, reply.message_id, True, reply.busy, reply.flag, data, checked=reply.checked
        )

    def close(self) -> None:
        """Close the port; may be called again."""
        held = getattr(self._port, "_socket", None)  # which pyserial forgets where the other side has left first
        with contextlib.suppress(OSError, termios.error):
            self._port.close()
        if held is not None:
            held.close()

    def _next(self, kind: str, axis: int, command: str, deadline: float) -> Message:
        """The next message of ``kind`` that belongs to the last command."""
        for line in self._arriving(command, deadline):
            self._wire_log.debug("< %s", repr(line)[2:-1])
            try:
                message = parse_message(line)
            except MalformedMessage as fault:
                if line[:1] == kind.encode():
                    raise BadReply(self.name, command, line, str(fault), _AGAIN) from None
                continue  # noise, or an alert or info that nobody waits for
            ours = (self._device, axis, self._message_id)
            if message.kind != kind or (message.device, message.axis, message.message_id) != ours:
                continue
            if kind == "#" and not message.continues:
                continue
            if self.checked and not message.checked:
                raise BadReply(self.name, command, line, "no checksum", _AGAIN)
            return message
        raise TimedOut(self.name, command, self._timeout_s, _CABLE)

    def _arriving(self, command: str, deadline: float) -> Iterator[bytes]:
        """Lines as they come in, until ``deadline``."""
        while time.monotonic() < deadline:
            if self._received:
                yield self._received.pop(0)
                continue
            with self._losses(command):
                self._received += self._lines.feed(self._port.read(self._port.in_waiting or 1))

    @contextlib.contextmanager
    def _losses(self, command: str) -> Iterator[None]:
        """Name what goes wrong with the port."""
        try:
            yield
        except serial.SerialTimeoutException:
            raise TimedOut(self.name, command, self._timeout_s, _CABLE, "room to write") from None
        except (OSError, termios.error, ValueError) as loss:  # of serial's errors; a malformed URL is a ValueError
            reason = " ".join(str(loss).split()) or type(loss).__name__
            raise ConnectionLost(self.name, command, reason, _CABLE) from loss
