"""Programs of others that open what is exported. They must be there where GREENOUGH_NEEDS_PEERS is 1, as in CI."""

import importlib
import os
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest


def need_program(name: str, package: str) -> None:
    """Skip where there is no such program; fail where GREENOUGH_NEEDS_PEERS says that there is."""
    if shutil.which(name) is None:
        _lack(f"{name} is not found: apt-get install {package}")


def need_module(name: str) -> Any:
    """A module of the extra ``peers``; skip where it cannot be imported, or fail, as above."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        _lack(f"{name} cannot be imported ({error}): pip install '.[peers]'")


def _lack(reason: str) -> None:
    if os.environ.get("GREENOUGH_NEEDS_PEERS", "0") == "1":
        pytest.fail(reason)
    pytest.skip(reason)


def run_headless(*command: str | Path) -> str:
    """Run a program without a screen, and return what it says."""
    headless = {key: value for key, value in os.environ.items() if key not in ("DISPLAY", "WAYLAND_DISPLAY")}
    headless["QT_QPA_PLATFORM"] = "offscreen"
    done = subprocess.run(list(map(str, command)), env=headless, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout + done.stderr
