"""What the machine refuses, every verb tells in one sentence, with 2 for its exit code, before work where it can.

Nothing half-written is left, and what was captured is kept.
"""

import contextlib
import os
import re
import resource
import subprocess
import sys
from collections.abc import Iterator
from importlib.metadata import entry_points
from pathlib import Path

import numpy as np
import pytest

from greenough.instrument import opening
from greenough.instrument.command import GROUP, run
from greenough.pipeline.acquisition import calibrate
from greenough.pipeline.calibration import Calibration
from greenough.twin.validation import demo
from greenough.twin.validation.acceptance import table
from machine_failures import (
    OUTPUTS,
    READ,
    WRITE_NOTHING,
    Output,
    Small,
    mounted,
    path_options,
    unmount,
    verbs,
    write_inputs,
)
from plain_rig import PlainRig

GREENOUGH = Path(sys.executable).with_name("greenough")


@pytest.fixture(scope="module")
def inputs(tmp_path_factory) -> Iterator[dict[str, Path]]:
    """What the verbs read."""
    folder = tmp_path_factory.mktemp("inputs")
    written = write_inputs(folder)
    sys.path.insert(0, str(folder))
    yield written
    sys.path.remove(str(folder))


@pytest.fixture
def small(tmp_path) -> Iterator[Small]:
    """A file system of 3 MB."""
    made = mounted(tmp_path / "small")
    if made is None:
        pytest.skip("this process may not mount a small file system")
    yield made
    unmount(made)


@pytest.fixture
def told(capsys):
    """Runs a command line, which must be refused in one sentence with exit code 2; returns the sentence."""

    def call(line: list[str]) -> str:
        capsys.readouterr()
        code = run(line, entry_points(group=GROUP))
        printed = capsys.readouterr()
        assert code == 2, printed
        assert "Traceback" not in printed.err
        assert "Exception ignored" not in printed.err
        (sentence,) = (line for line in printed.err.splitlines() if line.startswith("greenough: "))
        assert printed.err.splitlines()[-1] == sentence
        assert not sentence.endswith(".")
        return sentence

    return call


def files(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if not path.is_dir()}


def test_every_verb_and_every_option_that_names_a_file_is_tried_here():
    tried = {(output.verb, output.option) for output in OUTPUTS}
    assert path_options() == tried | READ
    assert set(verbs()) == {verb for verb, _ in tried} | WRITE_NOTHING


def below_a_file(folder: Path, output: Output) -> Path:
    (folder / "occupied").write_text("")
    return folder / "occupied" / output.name


def in_no_folder(folder: Path, output: Output) -> Path:
    return folder / "absent" / output.name


def of_the_other_kind(folder: Path, output: Output) -> Path:
    place = folder / output.name
    place.write_text("") if output.is_folder else place.mkdir()
    return place


def too_long(folder: Path, output: Output) -> Path:
    return folder / ("x" * 300 + output.name)


PLACES = {
    below_a_file: "is a file and not a folder",
    in_no_folder: "there is no folder",
    of_the_other_kind: "folder",
    too_long: "too long",
}


@pytest.fixture
def no_work(monkeypatch):
    """What opens a rig fails, so that a refusal must come before."""

    def begin(*arguments, **options):
        raise AssertionError("work began")

    monkeypatch.setattr(opening, "open_rig", begin)
    for module in (demo, table):
        monkeypatch.setattr(module, "open_twin", begin)


@pytest.mark.parametrize("place", PLACES, ids=lambda place: place.__name__)
@pytest.mark.parametrize("output", OUTPUTS, ids=str)
def test_an_impossible_place_is_told_before_work_begins(output, place, inputs, told, tmp_path, no_work):
    if place is in_no_folder and output.is_folder:
        pytest.skip("folders are made")
    where = place(tmp_path, output)
    before = files(tmp_path)
    sentence = told(output.line(where, inputs))
    assert PLACES[place] in sentence
    assert "cannot write" in sentence
    assert files(tmp_path) == before


@contextlib.contextmanager
def read_only(folder: Path) -> Iterator[Path]:
    """A folder in which nobody may make a file, not even root where it can be mounted so."""
    made = mounted(folder)
    if made is not None:
        made.remount("ro")
        try:
            yield folder
        finally:
            unmount(made)
        return
    if os.geteuid() == 0:
        pytest.skip("root may write in every folder here, and may not mount one that is read-only")
    folder.chmod(0o555)
    yield folder
    folder.chmod(0o755)


@pytest.mark.parametrize("output", OUTPUTS, ids=str)
def test_a_read_only_folder_is_told_before_work_begins(output, inputs, told, tmp_path, no_work):
    with read_only(tmp_path / "fixed") as folder:
        sentence = told(output.line(folder / output.name, inputs))
        assert re.search("its file system is read-only|you may not write in the folder", sentence)
        assert files(folder) == set()


@contextlib.contextmanager
def nothing_can_be_written() -> Iterator[None]:
    """No file of this process may become longer than 0 bytes, for which nobody needs to be root."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def work_of(output: Output, monkeypatch: pytest.MonkeyPatch) -> None:
    for work in output.work:
        work(monkeypatch)


def left(output: Output, folder: Path) -> set[str]:
    allowed = {str(path.relative_to(folder)) for path in folder.glob(output.may_leave)} if output.may_leave else set()
    return files(folder) - allowed


@pytest.mark.parametrize("output", OUTPUTS, ids=str)
def test_a_disk_that_is_full_is_told_and_nothing_half_written_is_left(output, inputs, told, small, monkeypatch):
    work_of(output, monkeypatch)
    small.fill()
    sentence = told(output.line(small.folder / output.name, inputs))
    assert re.match(r"greenough: cannot write \S+: the disk is full \(\d.* left on its file system", sentence)
    assert left(output, small.folder) == {"ballast"}


@pytest.mark.parametrize("output", OUTPUTS, ids=str)
def test_a_file_that_may_not_grow_is_told_and_not_left(output, inputs, told, tmp_path, monkeypatch):
    if "{elsewhere}" in " ".join(output.words):
        pytest.skip("what it writes elsewhere may not grow either")
    work_of(output, monkeypatch)
    place = tmp_path / output.name
    line = output.line(place, inputs)
    with nothing_can_be_written():
        sentence = told(line)
    assert "a file may not become so large here" in sentence
    assert left(output, tmp_path) == set()


@pytest.mark.slow
def test_a_calibration_goes_on_when_there_is_room_again(small, told, monkeypatch, tmp_path):
    rigs = []

    def open_rig(*arguments, exposures_done=0, **options):
        rigs.append(PlainRig("calibrate", exposures_done))
        return rigs[-1]

    monkeypatch.setattr(opening, "open_rig", open_rig)
    line = ["calibrate", "plain", "--out", str(small.folder / "cal.h5"), "--method", "paper"]
    sentence = told(line)
    assert f"what was captured is kept in {small.folder / 'cal.h5.partial'}" in sentence
    kept = files(small.folder)
    assert len([name for name in kept if "plane-" in name]) >= 2
    assert all(name.startswith("cal.h5.partial/") and "/." not in name for name in kept)
    small.remount("size=40m")
    assert run(line, entry_points(group=GROUP)) == 0
    assert rigs[0].sequences + rigs[1].sequences == 8 + 11 + 1, (
        "one posture or plane, that found no room, is done again"
    )
    assert files(small.folder) == {"cal.h5"}
    once = calibrate(PlainRig("calibrate"), tmp_path / "once.h5", "calibrate", method="paper")
    made = Calibration.load(small.folder / "cal.h5")
    np.testing.assert_array_equal(made.phase_height.coefficients, once.phase_height.coefficients)


UNREADABLE = {
    "check": ["{bad}.toml"],
    "calibrate": ["{bad}.toml", "--out", "{out}.h5"],
    "measure": ["plain", "--sample", "coin", "--calibration", "{bad}.h5", "--out", "{out}.ply"],
    "compare": ["{bad}.ply", "{mesh}"],
    "compare mesh": ["{cloud}", "{bad}.stl"],
    "export": ["{bad}.ply", "--out", "{out}.stl"],
    "export camera": ["{bad}.h5", "--out", "{out}.yaml"],
    "report": ["{bad}.ply", "--out", "{out}.html"],
    "report table": ["{bad}.json", "--out", "{out}.html"],
    "decode": ["{bad}.npy", "--out", "{out}.h5"],
    "decode image": ["{bad}.png", "--out", "{out}.h5", "--periods", "64", "--steps", "4"],
    "decode stack": ["{bad}.h5", "--out", "{out}.h5"],
    "decode archive": ["{bad}.npz", "--out", "{out}.h5"],
    "diagnose": ["{bad}.npy", "--periods", "64", "--steps", "4"],
    "record": ["twin", "--patterns", "{bad}.npy", "--sample", "coin", "--out", "{out}.h5"],
    "replay": ["{bad}.h5"],
    "study": ["{bad}.toml", "--out", "{out}"],
    "accept": ["twin", "--calibration", "{bad}.h5", "--out", "{out}.json"],
}


def missing(path: Path) -> None:
    pass


def a_folder(path: Path) -> None:
    path.mkdir()


def broken(path: Path) -> None:
    """The first read of it is an input/output error."""
    path.symlink_to("/proc/self/mem")


@pytest.mark.parametrize("kind", [missing, a_folder, broken], ids=lambda kind: kind.__name__)
@pytest.mark.parametrize("name", UNREADABLE)
def test_what_cannot_be_read_is_told(name, kind, inputs, told, tmp_path):
    (suffix,) = {Path(word).suffix for word in UNREADABLE[name] if "{bad}" in word}
    kind(tmp_path / f"bad{suffix}")
    words = {**inputs, "bad": tmp_path / "bad", "out": tmp_path / "out"}
    sentence = told([name.split()[0], *(word.format_map(words) for word in UNREADABLE[name])])
    assert str(tmp_path / f"bad{suffix}") in sentence
    if kind is broken and name not in ("decode", "decode archive"):  # whose size, here 0, is looked at first
        assert "input/output error" in sentence
    assert {path.name for path in tmp_path.iterdir()} <= {f"bad{suffix}"}


@pytest.mark.parametrize("unbuffered", ["", "1"])
@pytest.mark.parametrize("line", [["--help"], ["replay", "{recording}"], ["replay", "{recording}", "--json"]])
def test_standard_output_that_is_full_is_told(line, unbuffered, inputs):
    words = [GREENOUGH, *(word.format_map(inputs) for word in line)]
    environment = os.environ | {"PYTHONUNBUFFERED": unbuffered}
    with open("/dev/full", "w") as full:
        done = subprocess.run(words, stdout=full, stderr=subprocess.PIPE, text=True, env=environment)
    assert done.returncode == 2
    assert done.stderr == (
        "greenough: cannot write to standard output: no space left on device; remove the cause, or send it elsewhere\n"
    )


@pytest.mark.parametrize("unbuffered", ["", "1"])
@pytest.mark.parametrize("line", [["--help"], ["replay", "{recording}"], ["replay", "{recording}", "--json"]])
def test_a_reader_that_has_seen_enough_ends_it_without_a_word(line, unbuffered, inputs):
    reading, writing = os.pipe()
    os.close(reading)
    words = [GREENOUGH, *(word.format_map(inputs) for word in line)]
    environment = os.environ | {"PYTHONUNBUFFERED": unbuffered}
    done = subprocess.run(words, stdout=writing, stderr=subprocess.PIPE, text=True, env=environment)
    os.close(writing)
    assert (done.returncode, done.stderr) == (141, "")
