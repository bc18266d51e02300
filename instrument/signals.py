"""Signals that end a program: held back where they would do harm, and taken for the regular end of a server."""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from types import FrameType
from typing import NoReturn

_ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


@contextmanager
def signals_held() -> Iterator[None]:
    """Let signals that end the program wait for the end of the body, which must be short.

    Without it their exceptions would be raised inside of whatever Python function a library calls back, which not every
    library survives. Signals that are ignored, or that end the process at once, are left as they are.
    """
    if threading.current_thread() is not threading.main_thread():  # handlers run in no other thread
        yield
        return
    came: list[tuple[int, FrameType | None]] = []
    before = {}
    try:
        for number in _ENDING:
            handler = signal.getsignal(number)
            if callable(handler):
                before[number] = handler
                signal.signal(number, lambda number, frame: came.append((number, frame)))
        yield
    finally:
        for number, handler in reversed(before.items()):  # Ctrl-C last: until then it is only noted
            signal.signal(number, handler)
        if came:
            number, frame = came[0]
            before[signal.Signals(number)](number, frame)


@contextmanager
def until_told_to_end() -> Iterator[None]:
    """Ctrl-C and SIGTERM are how the body is meant to end: it does, and nothing is raised beyond.

    Where SIGINT is ignored, as it is in background jobs of shells that are not interactive, SIGTERM alone ends it.
    """
    in_main_thread = threading.current_thread() is threading.main_thread()
    before = signal.signal(signal.SIGTERM, _interrupt) if in_main_thread else None
    try:
        with suppress(KeyboardInterrupt):
            yield
    finally:
        if before is not None:
            signal.signal(signal.SIGTERM, before)


def _interrupt(number: int, frame: FrameType | None) -> NoReturn:
    raise KeyboardInterrupt
