"""Ctrl-C that is heard, for tests that interrupt something.

A background job of a shell that is not interactive is started with SIGINT ignored, and so is whatever it starts: a test
that then waits for the end of what it has interrupted waits for ever.
"""

import contextlib
import signal
from collections.abc import Iterator


@contextlib.contextmanager
def interrupts_heard() -> Iterator[None]:
    """Ctrl-C interrupts this process and those that it starts, even where it runs as a background job."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
