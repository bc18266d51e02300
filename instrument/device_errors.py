"""What a device at the end of a wire does wrong, as typed errors that all drivers raise.

Each is an InputError: the command line prints its one sentence, which names the device, the command and the remedy, and
exits with 2. All arguments are positional and kept as attributes, so that an error passes whole between processes.
"""

from .errors import InputError

_SHOWN = 64  # of what came over a wire; the rest is in the log


class DeviceError(InputError):
    """A device did not do what it was told.

    Parameters
    ----------
    device : str
        Which one and where, for example ``"stage on /dev/ttyUSB0"``.
    command : str
        What it was told, as a person reads it: ``"move abs 2000"``.
    what : str
        What happened instead.
    remedy : str
        What a person does about it, in the imperative.
    """

    def __init__(self, device: str, command: str, what: str, remedy: str):
        super().__init__(device, command, what, remedy)
        self.device, self.command, self.what, self.remedy = device, command, what, remedy

    def __str__(self) -> str:
        return f"{self.device}: {self.command}: {self.what}; {self.remedy}"


class TimedOut(DeviceError):
    """What was awaited, an answer or the end of a motion, did not come within ``timeout_s``."""

    def __init__(self, device: str, command: str, timeout_s: float, remedy: str, awaited: str = "an answer"):
        super().__init__(device, command, f"{awaited} did not come within {timeout_s:.3g} s", remedy)
        self.args = device, command, timeout_s, remedy, awaited
        self.timeout_s, self.awaited = timeout_s, awaited


class Rejected(DeviceError):
    """The device understood that it was told something, and refused: ``code`` is its own word or number for why."""

    def __init__(self, device: str, command: str, code: str | int, meaning: str, remedy: str):
        super().__init__(device, command, f"rejected with {code} ({meaning})", remedy)
        self.args = device, command, code, meaning, remedy
        self.code, self.meaning = code, meaning


class Fault(DeviceError):
    """The device reports that it is at fault: ``flag`` is its own name for what happened."""

    def __init__(self, device: str, command: str, flag: str, meaning: str, remedy: str):
        super().__init__(device, command, f"it reports {flag} ({meaning})", remedy)
        self.args = device, command, flag, meaning, remedy
        self.flag, self.meaning = flag, meaning


class BadReply(DeviceError):
    """Bytes came that the protocol does not allow: a wrong checksum, length or format, as ``reason`` says."""

    def __init__(self, device: str, command: str, reply: bytes, reason: str, remedy: str):
        shown = repr(reply[:_SHOWN])[1:] + ("..." if len(reply) > _SHOWN else "")
        super().__init__(device, command, f"the reply {shown} has {reason}", remedy)
        self.args = device, command, reply, reason, remedy
        self.reply, self.reason = reply, reason


class ConnectionLost(DeviceError):
    """The port or socket is closed, was refused or is gone, as ``reason`` says."""

    def __init__(self, device: str, command: str, reason: str, remedy: str):
        super().__init__(device, command, f"no connection ({reason})", remedy)
        self.args = device, command, reason, remedy
        self.reason = reason
