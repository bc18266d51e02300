"""What all tests share."""

import signal
from collections.abc import Iterator

import pytest

from interrupts import interrupts_heard


@pytest.fixture(scope="session", autouse=True)
def _interrupts_are_heard() -> Iterator[None]:
    """Where the tests run as a background job, they and what they start would not notice that they are interrupted."""
    if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:
        yield
        return
    with interrupts_heard():
        yield
