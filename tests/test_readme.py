"""What the README shows works as shown, on a coarse camera."""

import doctest
import glob
import re
import shlex
import signal
import subprocess
import sys
from collections.abc import Callable, Sequence
from importlib.metadata import entry_points
from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest
import trimesh
from emulated_gige import free_address, need_aravis

from greenough.instrument import Placement
from greenough.instrument.command import GROUP, run
from greenough.pipeline.acquisition import plane_heights
from greenough.pipeline.fringes import FringeSet
from greenough.pipeline.gray_code import stripe_patterns
from greenough.twin.validation.studies import builtin_studies
from image_folders import keep, keep_as_it_lies
from plain_rig import PlainRig

README = Path(__file__).parent.parent / "README.md"

# Spots on coarse pixels must be large to be found.
COARSE = (
    "camera.rows=240", "camera.cols=320", "twin.optics.camera_focal_px=5670.75", "twin.render.nodes=16",
    "board.small_diameter_mm=0.3", "board.big_diameter_mm=0.5", "procedure.postures=8", "procedure.planes=12",
    "procedure.plane_step_mm=0.25",
)  # fmt: skip


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", README.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)


def command(line: str, *settings: str) -> int:
    words = [name for word in shlex.split(line)[1:] for name in (sorted(glob.glob(word)) if "*" in word else [word])]
    coarse = COARSE if {"twin", "wire"} & set(words) else ()
    more = [word for setting in (*coarse, *settings) for word in ("--set", setting)]
    return run([*words, *more], entry_points(group=GROUP))


def dome() -> trimesh.Trimesh:
    """A shallow dome, in mm."""
    x, y = np.meshgrid(np.linspace(-5, 5, 81), np.linspace(-4, 4, 65))
    index = np.arange(x.size).reshape(x.shape)
    corners = np.stack([index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]], axis=-1).reshape(-1, 4)
    faces = np.concatenate([corners[:, [0, 1, 2]], corners[:, [0, 2, 3]]])
    vertices = np.column_stack([x.ravel(), y.ravel(), 0.3 - (x**2 + y**2).ravel() / 60])
    return trimesh.Trimesh(vertices, faces, process=False)


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Where the reader works: with the frames and meshes that the commands name."""
    folder = tmp_path_factory.mktemp("reader")
    mesh = dome()
    mesh.export(folder / "nominal.stl")
    mesh.apply_scale(1000).export(folder / "part.stl")  # in um
    return folder


@pytest.mark.slow
def test_examples_run_in_the_order_of_the_page_and_the_commands_with_them(folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    examples = doctest.DocTestParser().get_doctest("\n".join(blocks("python")), {}, "README.md", str(README), 0)
    lines = "".join(blocks("sh")).splitlines()
    verbs = {line.split()[1] for line in lines}
    assert verbs == {
        "accept",
        "demo",
        "check",
        "calibrate",
        "measure",
        "compare",
        "export",
        "decode",
        "diagnose",
        "record",
        "replay",
        "report",
        "optics",
        "study",
    }

    patterns = np.load(saved_by(examples, "patterns.npy"))
    Path("frames").mkdir()
    for k, pattern in enumerate(patterns):
        cv2.imwrite(f"frames/{k:02d}.png", pattern // 2 + 50)  # neither dark nor saturated

    others = FringeSet((70, 64, 59), (4, 4, 4), field=1024, sign=-1)
    Path("theirs").mkdir()
    for k, pattern in enumerate(others.patterns(64, 1024)):
        cv2.imwrite(f"theirs/freq{2 - k // 4}_step{k % 4}.png", pattern.T // 2 + 50)
    fringes = FringeSet((20,), (3,), field=608).patterns(64, 608) // 2 + 50
    code = np.broadcast_to(stripe_patterns(608, 20, 6)[:, None], (6, 64, 608))
    np.savez("coded.npz", np.concatenate([fringes, code]))

    # What the study's runs find is tested in twin/validation; here they only have to be made.
    runs: list[str] = []
    monkeypatch.setattr("greenough.twin.validation.cost.cost_figures", cost_figures(runs))
    own, stage = blocks("toml")
    Path("stage.toml").write_text(stage, encoding="utf-8")

    Path("own.toml").write_text(own, encoding="utf-8")
    with PlainRig() as rig:  # is in no way a twin
        keep(rig, Path(), plane_heights(rig))
        rig.operator.place(Placement("tilted plane"))
        keep_as_it_lies(rig, Path("part"))

    for line in lines:
        # The demo and the comparison of its files are run by twin/validation/test_demo.py; all artefacts take more than
        # a minute even on coarse pixels, and full/test_acceptance.py runs them.
        if "demo" not in line and "accept" not in line:
            assert command(line) == 0, f"{line}\n{capsys.readouterr().err}"
    assert len(runs) == 10
    assert 0.3 < np.median(trimesh.load("own.ply").vertices[:, 2]) < 0.5  # mm, the plain rig's tilted plane
    for name in ("phase.h5", "theirs.h5", "coded.h5"):
        with h5py.File(name) as file:
            assert np.mean(file["valid"][()]) > 0.9, name

    runner = doctest.DocTestRunner(verbose=False)
    report: list[str] = []
    runner.run(examples, out=report.append)
    assert runner.failures == 0, "".join(report)
    assert runner.tries == len(examples.examples) > 25


@pytest.mark.slow
def test_devices_behind_wires_are_checked_calibrated_and_measured_with(folder, monkeypatch, capsys):
    need_aravis()
    monkeypatch.chdir(folder)
    host = free_address()  # in place of 127.0.0.1, where something else may listen
    settings = [f'lightcrafter.host="{host}"', f'zaber.port="socket://{host}:21846"', f'genicam.address="{host}"']
    settings.append(f'operator.address="{host}:21847"')
    serve, *lines = "".join(blocks("bash")).splitlines()
    assert [line.split()[1] for line in lines] == ["check", "live", "calibrate", "measure"]
    arguments = [word for setting in (*COARSE, *settings) for word in ("--set", setting)]
    server = [Path(sys.executable).with_name("greenough"), *shlex.split(serve)[1:], "--json", *arguments]
    with subprocess.Popen(server, stdout=subprocess.PIPE, text=True) as served:
        try:
            assert served.stdout is not None
            assert any(line == "}\n" for line in iter(served.stdout.readline, "")), "it listens"
            for line in lines:
                ending = " --rounds 2 --port 0" if "live" in line else ""
                assert command(line + ending, *settings) == 0, f"{line}\n{capsys.readouterr().err}"
        finally:
            served.send_signal(signal.SIGINT)
    assert served.returncode == 0
    points = trimesh.load("wire-coin.ply").vertices
    assert len(points) > 10_000
    assert abs(np.median(points[:, 2])) < 0.2  # mm


def cost_figures(runs: list[str]) -> Callable[..., list[dict[str, float | str]]]:
    def measure(rig: str, overrides: Sequence[str], run: str, advance: object) -> list[dict[str, float | str]]:
        runs.append(run)
        return [{"calibration": "bundle", "step_um": 0.1}]

    return measure


def saved_by(examples: doctest.DocTest, name: str) -> str:
    """Run the examples up to the one that saves ``name``, which the commands need."""
    scope: dict[str, object] = {}
    for example in examples.examples:
        exec(compile(example.source, "README.md", "single"), scope)
        if f'"{name}"' in example.source:
            return name
    raise AssertionError(f"no example saves {name}")


def test_opens_with_the_two_lines_that_matter():
    lines = README.read_text(encoding="utf-8").splitlines()
    assert [line.strip() for line in lines[2:4]] == ["make demo", "make test"]


def test_every_study_is_listed():
    table = README.read_text(encoding="utf-8").partition("| study | what |")[2].partition("\n\n")[0]
    assert set(re.findall(r"`([\w-]+)`", table)) == set(builtin_studies())


def test_linked_files_exist():
    links = re.findall(r"\]\((?!https:)([^)#]+)\)", README.read_text(encoding="utf-8"))
    assert links
    for link in links:
        assert (README.parent / link).exists(), link
