"""What the figures were measured with."""

import os
import platform
import subprocess
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from greenough.instrument.backend import backend

from ...renderer import dr
from .. import claims

PEERS = ("fringes", "distributed")


def environment() -> dict[str, Any]:
    """What claims state of machine and versions, and beside it the processor, its threads, the GPU and the peers."""
    found = claims.environment()
    packages = found.pop("packages") | {name: _version(name) for name in PEERS}
    machine = {
        "processor": _processor(),
        "cores": len(os.sched_getaffinity(0)),
        "threads": dr.thread_count(),
        "backend": backend(),
        "gpu": _gpu() if backend() == "cuda" else None,
    }
    return found | machine | {"packages": packages}


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def _processor() -> str:
    """As /proc/cpuinfo names it; on machines that do not, their architecture."""
    lines = Path("/proc/cpuinfo").read_text().splitlines()
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()


def _gpu() -> str:
    query = ["nvidia-smi", "--query-gpu=name", "--format=csv,noheader"]
    try:
        done = subprocess.run(query, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return done.stdout.splitlines()[0]
