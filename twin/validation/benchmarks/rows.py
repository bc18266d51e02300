"""The lines of a table of timings, and how works are timed so that they can be compared."""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Row:
    """One line of a table: a figure, what it is compared with, and what it must keep to.

    Parameters
    ----------
    name : str
    value : float
        In ``unit``.
    unit : str
    peer : str or None
        What ``value`` is compared with.
    ratio : float or None
        ``value`` over the peer's: at most 0.05 is what twenty times as fast must keep to.
    limit : float or None
        The most that the ratio, or without a peer the value, may be. None: reported only.
    holds : bool or None
        Whether the limit is kept to.
    """

    name: str
    value: float
    unit: str
    peer: str | None = None
    ratio: float | None = None
    limit: float | None = None
    holds: bool | None = None


def limited(name: str, value: float, unit: str, peer: str | None, ratio: float | None, limit: float) -> Row:
    """A row that holds if its ratio, or where it has none its value, does not exceed ``limit``; NaN never does."""
    judged = value if ratio is None else ratio
    return Row(name, value, unit, peer, ratio, limit, bool(judged <= limit))


def interleaved(works: Mapping[str, Callable[[], object]], repeats: int) -> dict[str, float]:
    """Median wall times of several works, which take turns so that a machine whose speed drifts slows all alike.

    Parameters
    ----------
    works : mapping of str to callable
        Each is a whole piece of work: what a GPU or Dr.Jit does for it must be finished when it returns. Each is run
        once before it is timed, which compiles its kernels.
    repeats : int
        Times each is timed, at least 1.

    Returns
    -------
    dict of str to float
        s, by the works' names.
    """
    for work in works.values():
        work()
    times: dict[str, list[float]] = {name: [] for name in works}
    for _ in range(repeats):
        for name, work in works.items():
            start = time.perf_counter()
            result = work()
            times[name].append(time.perf_counter() - start)
            del result
    return {name: float(np.median(seconds)) for name, seconds in times.items()}
