"""Rules for all tests: one Hypothesis profile, a time-out for each test, and how long an unmarked test may take."""

import os
import signal
import time
from collections.abc import Iterator
from functools import cache

import pytest
from hypothesis import settings

from interrupts import interrupts_heard

LONGEST_S = 2.0
"""A test that takes longer should be marked slow.

An unmarked one that takes `SCATTER` times as long fails the run where GREENOUGH_LONGEST_TEST is set, as in CI. The
seconds are those of a machine that counts to a million in ``COUNT_S``, which is assumed; on a slower one a test may
take longer.
"""

COUNT_S = 0.06
SCATTER = 2.0  # times of one test scatter by as much from run to run, and a test that fails by chance is no help

TIMEOUTS_S = {"slow": 1200, "browser": 600, "peers": 600, "full": 7200}
"""A test that takes longer hangs; ``timeout`` in pyproject.toml is that of all others."""

# Busy machines make single examples slow, and the same examples every time make failures repeatable.
settings.register_profile("greenough", deadline=None, derandomize=True)
settings.load_profile("greenough")

_too_long: list[str] = []


@pytest.fixture(scope="session", autouse=True)
def _interrupts_are_heard() -> Iterator[None]:
    """Where the tests run as a background job, they and what they start would not notice that they are interrupted."""
    if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:
        yield
        return
    with interrupts_heard():
        yield


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        for mark, seconds in TIMEOUTS_S.items():
            if item.get_closest_marker(mark) and not item.get_closest_marker("timeout"):
                item.add_marker(pytest.mark.timeout(seconds))


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Iterator[None]:
    """Note the processor time of a test and of the processes that it started."""
    before = _processor_s()
    try:
        return (yield)
    finally:
        item.user_properties.append(("processor_s", _processor_s() - before))


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    """Collect tests that should be marked. The time of fixtures that tests share is not a test's own."""
    if report.when != "call" or not report.passed or set(report.keywords) & TIMEOUTS_S.keys():
        return
    # On a busy machine the clock counts what others compute; a test that only waits is bound by its time-out.
    seconds = min(report.duration, dict(report.user_properties).get("processor_s", report.duration))
    if seconds > SCATTER * LONGEST_S * _slowness():
        _too_long.append(f"{report.nodeid} takes {seconds / _slowness():.1f} s")


@pytest.hookimpl(trylast=True)
def pytest_sessionfinish(session: pytest.Session, exitstatus: int) -> None:
    if _too_long and os.environ.get("GREENOUGH_LONGEST_TEST") and exitstatus == pytest.ExitCode.OK:
        session.exitstatus = pytest.ExitCode.TESTS_FAILED


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    if _too_long and os.environ.get("GREENOUGH_LONGEST_TEST"):
        terminalreporter.section(f"unmarked tests above {SCATTER * LONGEST_S:g} s: make them faster, or mark them slow")
        for line in _too_long:
            terminalreporter.write_line(line)


@cache
def _slowness() -> float:
    """How many times as long as the reference this machine takes to count, at least 1."""
    began = time.process_time()
    total = 0
    for number in range(1_000_000):
        total += number
    return max(1.0, (time.process_time() - began) / COUNT_S)


def _processor_s() -> float:
    used = os.times()
    return used.user + used.system + used.children_user + used.children_system
