"""Every verb with every option that names what it writes, how to bring it there cheaply, and places that refuse it."""

import os
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from importlib.metadata import entry_points
from pathlib import Path
from types import SimpleNamespace
from typing import Annotated, Any, get_args, get_origin, get_type_hints

import cv2
import numpy as np
import pytest
import typer
from typer.models import OptionInfo

from greenough.instrument import opening
from greenough.instrument.command import GROUP, collect
from greenough.instrument.contract import Placement
from greenough.instrument.recording import record
from greenough.pipeline import acquisition, camera_file
from greenough.pipeline.fringes import FringeSet
from greenough.pipeline.point_cloud import Mesh, PointCloud, write_cloud, write_mesh
from greenough.pipeline.reconstruct import PointMap
from greenough.pipeline.report import results
from greenough.pipeline.report.page import Page
from greenough.twin.validation import demo
from greenough.twin.validation.acceptance import table
from greenough.twin.validation.judged_table import JudgedTable
from plain_rig import PlainRig
from small_calibration import small_calibration

PATTERNS = np.tile(np.arange(608, dtype=np.uint8), (3, 2, 1))

READ = {
    ("measure", "--calibration"),
    ("record", "--patterns"),
    ("diagnose", "--calibration"),
    ("accept", "--calibration"),
}
"""Options that name files which are only read."""

WRITE_NOTHING = {"check", "compare", "replay", "live", "serve", "bench"}
"""Verbs that print, and write no file but for a while, in folders for temporary files."""


@dataclass(frozen=True)
class Output:
    """An option that names what a verb writes.

    Parameters
    ----------
    verb : str
    option : str
    name : str
        Of the file, or of the folder.
    words : sequence of str
        The rest of the command line, in which names of `inputs` stand in braces.
    work : sequence of callable
        What stands for minutes of work, given the monkeypatch.
    is_folder : bool
    may_leave : str
        Pattern of files that may be left, in the place of the output.
    """

    verb: str
    option: str
    name: str
    words: Sequence[str]
    work: Sequence[Callable[[pytest.MonkeyPatch], None]] = field(default=())
    is_folder: bool = False
    may_leave: str = ""

    def __str__(self) -> str:
        return f"{self.verb} {self.option} {self.name}"

    def line(self, place: Path, inputs: Mapping[str, Path]) -> list[str]:
        """The command line with the output at ``place``."""
        words = [word.format_map(inputs) for word in self.words]
        return [self.verb, *words, self.option, str(place)]


def _rig_of_pinholes(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(opening, "open_rig", lambda *arguments, **options: PlainRig())
    for module in (demo, table):
        patch.setattr(module, "open_twin", lambda *arguments, **options: (PlainRig(), None))


def _made_at_once(patch: pytest.MonkeyPatch) -> None:
    made = small_calibration()
    patch.setattr(
        opening, "open_rig", lambda *arguments, **options: nullcontext(SimpleNamespace(procedure=made.procedure))
    )
    xyz = np.stack([*np.mgrid[:6, :8].astype(float), np.zeros((6, 8))], axis=-1)
    patch.setattr(acquisition, "calibrate", lambda *arguments: made)
    patch.setattr(results, "calibration_page", lambda *arguments, **options: Page("Calibration", "", []))
    patch.setattr(acquisition, "measure", lambda *arguments: PointMap(xyz))


def _accepted_at_once(patch: pytest.MonkeyPatch) -> None:
    def accept(rig: str, overrides: Any, calibration: Any, out: Path, advance: Any) -> JudgedTable:
        table._write(out, JudgedTable((), {}), {})
        return JudgedTable((), {})

    patch.setattr(table, "accept", accept)
    patch.setattr(table, "captures", lambda *arguments, **options: 1)


def _camera_at_once(patch: pytest.MonkeyPatch) -> None:
    camera = camera_file.OpenCVCamera(np.eye(3), np.zeros(5), np.eye(4), np.full(9, 0.1))
    patch.setattr(camera_file, "opencv_camera", lambda calibration: camera)


EXPORTS = ("ply", "xyz", "asc", "npz", "stl", "obj", "x3p", "gwy", "gsf")
CAMERAS = ("yaml", "json", "xml")
MEASURE = ("plain", "--sample", "coin")
OUTPUTS = (
    Output("calibrate", "--out", "cal.h5", ["plain"], [_rig_of_pinholes], may_leave="cal.h5.partial/*"),
    Output("calibrate", "--report", "cal.html", ["plain", "--out", "{elsewhere}/cal.h5"], [_made_at_once]),
    Output("measure", "--out", "coin.ply", [*MEASURE, "--calibration", "{calibration}"], [_made_at_once]),
    Output(
        "measure",
        "--report",
        "coin.html",
        [*MEASURE, "--calibration", "{calibration}", "--out", "{elsewhere}/coin.ply"],
        [_made_at_once],
    ),
    Output("measure", "--preview", "coin.png", [*MEASURE], [_rig_of_pinholes]),
    *(Output("export", "--out", f"coin.{ending}", ["{cloud}"]) for ending in EXPORTS),
    *(Output("export", "--out", f"camera.{ending}", ["{calibration}"], [_camera_at_once]) for ending in CAMERAS),
    Output("decode", "--out", "phase.h5", ["{frames}", "--periods", "608,152,40,12", "--steps", "4,4,4,12"]),
    Output("diagnose", "--lut-out", "lut.txt", ["{frames}", "--periods", "608,152,40,12", "--steps", "4,4,4,12"]),
    Output("report", "--out", "page.html", ["{table}"]),
    Output("report", "--png", "figures", ["{cloud}", "--out", "{elsewhere}/page.html"], is_folder=True),
    Output(
        "record", "--out", "recording.h5", ["plain", "--patterns", "{patterns}", "--sample", "coin"], [_rig_of_pinholes]
    ),
    Output("optics", "--out", "optics", [], is_folder=True),
    Output("demo", "--out", "demo", [], [_rig_of_pinholes], True, "demo/calibration.h5.partial/*"),
    Output("accept", "--out", "table.json", ["twin"], [_rig_of_pinholes], may_leave="table-calibration.h5.partial/*"),
    Output("accept", "--report", "table.html", ["twin", "--out", "{elsewhere}/table.json"], [_accepted_at_once]),
    Output("study", "--out", "study", ["{study}"], is_folder=True),
)


def path_options() -> set[tuple[str, str]]:
    """Every verb of the installed command with every option of it that names a path."""
    found = set()
    for verb, function in verbs().items():
        for name, hint in get_type_hints(function, include_extras=True).items():
            for kind, option in _annotated(hint):
                if Path in (kind, *get_args(kind)) and isinstance(option, OptionInfo):
                    flag = option.default  # where typer keeps the first of an option's names
                    found.add((verb, flag if isinstance(flag, str) else f"--{name}"))
    return found


def verbs() -> dict[str, Callable]:
    """The functions behind the verbs of the installed command."""
    found: dict[str, Callable] = {}
    apps = [collect(entry_points(group=GROUP))]
    while apps:
        app = apps.pop()
        for command in app.registered_commands:
            assert command.callback is not None
            found[command.name or command.callback.__name__.replace("_", "-")] = command.callback
        apps += [
            group.typer_instance for group in app.registered_groups if isinstance(group.typer_instance, typer.Typer)
        ]
    return found


def _annotated(hint: Any) -> Iterator[tuple[Any, Any]]:
    if get_origin(hint) is Annotated:
        kind, *notes = get_args(hint)
        yield from ((kind, note) for note in notes)


EXPERIMENT = """
def measure(rig, overrides, run, advance):
    return [{"height_um": 1.0}]
"""


def write_inputs(folder: Path) -> dict[str, Path]:
    """What the verbs read: a cloud, a calibration, bent frames, patterns, a recording, a table and a study, by name."""
    folder.mkdir(exist_ok=True)
    v, u = np.mgrid[:12, :17]
    xyz = np.stack([0.01 * u, -0.01 * v, 0.001 * u], axis=-1).reshape(-1, 3)
    pixels = np.stack([v.ravel(), u.ravel()], axis=-1).astype(np.int32)
    write_cloud(folder / "cloud.ply", PointCloud(xyz, pixels, noise_mm=np.full(xyz.shape, 1e-3, np.float32)))
    corners = np.array([[-9.0, -9, 0], [9, -9, 0], [9, 9, 0], [-9, 9, 0]])
    write_mesh(folder / "mesh.ply", Mesh(corners, np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32)))
    made = small_calibration()
    figures = {"reprojection_rmse_u_px": 0.03, "reprojection_rmse_v_px": 0.04}
    replace(made, figures=figures).save(folder / "cal.h5")
    grey = FringeSet((608, 152, 40, 12), (4, 4, 4, 12)).patterns(40, 608) / 255.0
    bent = 20 + 180 * grey**1.4 + np.random.default_rng(1).normal(0, 1.5, grey.shape)
    np.save(folder / "frames.npy", np.rint(bent).astype(np.uint8))
    cv2.imwrite(str(folder / "frame.png"), np.zeros((4, 4), np.uint8))
    np.save(folder / "patterns.npy", PATTERNS)
    with record(PlainRig(), folder / "recording.h5") as rig:
        rig.operator.place(Placement("coin"))
        rig.capture(PATTERNS)
    (folder / "table.json").write_text('{"rows": []}')
    (folder / "flat_experiment.py").write_text(EXPERIMENT)
    (folder / "study.toml").write_text('name = "flat"\nkind = "flat_experiment:measure"\nseeds = 1\n')
    (folder / "elsewhere").mkdir()
    names = {"calibration": "cal.h5", "frames": "frames.npy", "patterns": "patterns.npy", "table": "table.json"}
    names |= {"cloud": "cloud.ply", "study": "study.toml", "recording": "recording.h5", "elsewhere": "elsewhere"}
    return {name: folder / file for name, file in (names | {"mesh": "mesh.ply"}).items()}


@dataclass(frozen=True)
class Small:
    """A mounted file system of 3 MB."""

    folder: Path

    def remount(self, options: str) -> None:
        """With other options: ``ro``, or another size."""
        subprocess.run(["mount", "-o", f"remount,{options}", str(self.folder)], check=True, capture_output=True)

    def fill(self) -> None:
        """To its last byte."""
        space = os.statvfs(self.folder)
        with open(self.folder / "ballast", "wb") as file:
            os.posix_fallocate(file.fileno(), 0, space.f_bavail * space.f_frsize)


def mounted(folder: Path) -> Small | None:
    """A file system of 3 MB at ``folder``; None where this process may not mount one."""
    folder.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=3m", "tmpfs", str(folder)]
    try:
        done = subprocess.run(command, capture_output=True, timeout=30)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return Small(folder) if done.returncode == 0 and sys.platform == "linux" else None


def unmount(small: Small) -> None:
    """Also where something holds it."""
    subprocess.run(["umount", "-l", str(small.folder)], check=True, capture_output=True)
