"""Programs of others that open what is exported. They must be there where GREENOUGH_NEEDS_PEERS is 1, as in CI."""

import importlib.util
import os
import shutil
import subprocess
from pathlib import Path

import pytest


def need(name: str, remedy: str) -> None:
    """Skip where neither a program nor a module has this name; fail where GREENOUGH_NEEDS_PEERS says that it is."""
    if shutil.which(name) is None and importlib.util.find_spec(name) is None:
        reason = f"{name} is not found: {remedy}"
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
