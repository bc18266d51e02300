"""How much memory a piece of work takes, by what Linux says of this process."""

import gc
from collections.abc import Callable
from pathlib import Path

from greenough.pipeline.jit import dr


def peak_mb(work: Callable[[], object]) -> float:
    """How far a piece of work raises this process's resident memory above where it was before, 1e6 bytes.

    What it works on must be there already; its result counts.
    """
    gc.collect()
    dr.flush_malloc_cache()
    Path("/proc/self/clear_refs").write_text("5")  # the peak starts anew
    before = _status_kb("VmRSS")
    result = work()
    peak = _status_kb("VmHWM")
    del result
    return 1024e-6 * (peak - before)


def _status_kb(field: str) -> int:
    lines = Path("/proc/self/status").read_text().splitlines()
    return int(next(line for line in lines if line.startswith(f"{field}:")).split()[1])
