import itertools
import math
import time
from dataclasses import fields

import pytest

from greenough.twin.validation.benchmarks import rows
from greenough.twin.validation.benchmarks.rows import Row, interleaved, limited


def test_a_row_has_the_columns_that_scripts_rely_on() -> None:
    assert [field.name for field in fields(Row)] == ["name", "value", "unit", "peer", "ratio", "limit", "holds"]


def test_the_ratio_to_a_peer_is_judged_and_without_one_the_value() -> None:
    assert limited("a", 7.0, "s", "b", 2.0, 2.0).holds is True
    assert limited("a", 1.0, "s", "b", 2.1, 2.0).holds is False
    assert limited("a", 2.0, "s", None, None, 2.0).holds is True
    assert limited("a", 2.1, "s", None, None, 2.0).holds is False


def test_what_has_no_figure_does_not_hold() -> None:
    assert limited("a", 1.0, "s", "b", math.nan, 2.0).holds is False
    assert limited("a", math.inf, "s", None, None, 2.0).holds is False


def test_works_take_turns_after_each_was_done_once() -> None:
    done = []
    times = interleaved({"a": lambda: done.append("a"), "b": lambda: done.append("b")}, repeats=3)
    assert done == ["a", "b"] * 4
    assert list(times) == ["a", "b"]


def test_the_first_run_and_outliers_do_not_count(monkeypatch: pytest.MonkeyPatch) -> None:
    """On a clock that stands still but for the works."""
    clock = [0.0]
    durations = {"steady": itertools.repeat(1.0), "jumpy": iter([500.0, 3.0, 90.0, 1.0, 2.0, 3.0])}
    monkeypatch.setattr(rows, "time", type("Clock", (), {"perf_counter": lambda: clock[0]}))

    def work(name: str) -> None:
        clock[0] += next(durations[name])

    times = interleaved({name: lambda name=name: work(name) for name in durations}, repeats=5)
    assert times == {"steady": 1.0, "jumpy": 3.0}


def test_times_are_seconds_of_the_wall() -> None:
    assert interleaved({"nap": lambda: time.sleep(0.02)}, repeats=1)["nap"] >= 0.02
