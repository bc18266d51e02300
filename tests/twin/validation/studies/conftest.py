"""An experiment that costs nothing, in a module of its own, so that workers of a cluster find it too."""

import json
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

EXPERIMENT = '''
"""Draws a height with the stage's spread, notes down who was here and when, and refuses seed 4."""
import json, os, time
from pathlib import Path

import cv2

from greenough.instrument.errors import InputError
from greenough.instrument.rigfile import load_rig_file
from greenough.pipeline.jit import dr
from greenough.twin.randomness import run_rng
from greenough.twin.settings import twin_settings


def measure(rig, overrides, run, advance):
    settings = twin_settings(load_rig_file(rig, overrides))
    visit = {"pid": os.getpid(), "seed": settings.seed, "run": run, "start": time.monotonic()}
    visit |= {"sd": settings.stage.position_sd_um}
    time.sleep(0.05)
    visit |= {"threads": [dr.thread_count(), cv2.getNumThreads()], "end": time.monotonic()}
    with Path(__file__).with_name(f"{run.split()[0]}.visits").open("a") as file:
        file.write(json.dumps(visit) + "\\\\n")
    while settings.seed > 5 and Path(__file__).with_name("hold").exists():
        time.sleep(0.01)
    if settings.seed == 4:
        raise InputError("the board was not found")
    if (deadly := Path(__file__).with_name("deadly")).exists() and settings.seed == 5:
        deadly.unlink(missing_ok=True)  # two runs may have seen it
        os._exit(1)
    height = run_rng(settings.seed, run, "height").normal(0, settings.stage.position_sd_um)
    return [{"method": "a", "height_um": height, "lost_um": float("nan")}, {"method": "b", "height_um": 2 * height}]
'''.replace("\\\\n", "\\n")


@pytest.fixture(scope="module")
def laboratory(tmp_path_factory) -> Iterator[Path]:
    """A folder with the experiment, which this process and its children import as ``heights:measure``."""
    folder = tmp_path_factory.mktemp("laboratory")
    (folder / "heights.py").write_text(EXPERIMENT)
    sys.path.insert(0, str(folder))
    yield folder
    sys.path.remove(str(folder))
    sys.modules.pop("heights", None)


@pytest.fixture
def study_file(laboratory) -> Callable[..., Path]:
    """Writes a study of the experiment with two cases; ``changes`` are lines in front of the sections."""

    def written(name: str, *changes: str, seeds: str = "3", sections: str = "") -> Path:
        path = laboratory / f"{name}.toml"
        lines = [f'name = "{name}"', 'kind = "heights:measure"', f"seeds = {seeds}", *changes, "[cases]"]
        lines += [f'"{sd}" = ["twin.stage.position_sd_um={sd}"]' for sd in (1, 2)]
        path.write_text("\n".join([*lines, sections]))
        return path

    return written


@pytest.fixture
def visits(laboratory) -> Callable[[str], list[SimpleNamespace]]:
    """What the experiment noted down in the runs of a study, in their order."""

    def read(name: str) -> list[SimpleNamespace]:
        path = laboratory / f"{name}.visits"
        lines: list[dict[str, Any]] = [json.loads(line) for line in path.read_text().splitlines()]
        return [SimpleNamespace(**line) for line in lines]

    return read
