import json
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from greenough.instrument import open_rig
from greenough.instrument.command import GROUP, run
from greenough.instrument.contract import Placement
from greenough.instrument.recording import record


@pytest.fixture
def greenough(capsys: pytest.CaptureFixture[str]):
    """Runs a command line of the instrument's verbs; returns the exit code, the JSON and the errors."""

    def call(*arguments: object) -> tuple[int, Any, str]:
        source = EntryPoint("instrument", "greenough.instrument.commands:app", GROUP)
        code = run([str(argument) for argument in arguments], [source])
        printed = capsys.readouterr()
        return code, json.loads(printed.out) if printed.out.startswith("{") else printed.out, printed.err

    return call


@pytest.fixture
def source(tmp_path: Path, fake_rig, patterns) -> Path:
    """A recording of board and coin at two heights, to stand in for a rig."""
    path = tmp_path / "source.h5"
    with record(fake_rig(), path) as rig:
        for part in ("board", "coin"):
            rig.operator.place(Placement(part))
            for height in (0.0, 0.5):
                rig.stage.move_to_mm(height)
                rig.capture(patterns)
    np.save(tmp_path / "patterns.npy", patterns)
    return path


def test_check_of_a_recording_reports_identity_and_limits(greenough, source: Path) -> None:
    code, result, errors = greenough("check", source, "--json")
    assert (code, errors) == (0, "")
    assert result["name"] == "fake"
    assert result["camera_shape"] == [12, 16]
    assert result["exposure_limits_us"] == [100.0, 1e6]
    assert result["stage_limits_mm"] == [-1.6, 1.6]
    code, text, _ = greenough("check", source)
    assert code == 0
    assert "stage_limits_mm" in text
    assert "-1.6, 1.6" in text
    assert "checks" not in result
    assert "devices" not in result


def test_record_writes_what_the_rig_showed(greenough, source: Path, tmp_path: Path, patterns) -> None:
    out = tmp_path / "out.h5"
    arguments = ["--patterns", tmp_path / "patterns.npy", "--sample", "board", "--sample", "coin"]
    code, result, errors = greenough(
        "record", source, "--out", out, *arguments, "--z-mm", "0", "--z-mm", "0.5", "--json"
    )
    assert (code, errors) == (0, "")
    assert result == {"recording": str(out), "captures": 4, "frames": 16}
    expected, found = open_rig(source), open_rig(out)
    for part in ("board", "coin"):
        for rig in (expected, found):
            rig.operator.place(Placement(part))
        for height in (0.0, 0.5):
            for rig in (expected, found):
                rig.stage.move_to_mm(height)
            first, second = (rig.capture(patterns) for rig in (expected, found))
            np.testing.assert_array_equal(first.stack, second.stack)
            assert first.stage_position_mm == second.stage_position_mm


def test_replay_lists_every_capture(greenough, source: Path) -> None:
    code, result, errors = greenough("replay", source, "--json")
    assert (code, errors) == (0, "")
    assert [row["part"] for row in result["captures"]] == ["board", "board", "coin", "coin"]
    assert [row["first_serial"] for row in result["captures"]] == [0, 4, 8, 12]
    rig = open_rig(source)
    rig.operator.place(Placement("board"))
    assert result["captures"][0]["frames"] == 4
    code, text, _ = greenough("replay", source)
    assert code == 0
    assert len([line for line in text.splitlines() if "coin" in line]) == 2


def test_bad_input_is_refused_and_leaves_nothing(greenough, source: Path, tmp_path: Path, patterns) -> None:
    np.save(tmp_path / "wrong.npy", patterns[:, 1:])
    (tmp_path / "text.npy").write_text("no array")
    out = tmp_path / "out.h5"
    good = ["--patterns", tmp_path / "patterns.npy", "--sample", "board"]
    cases = [
        (["check", tmp_path / "absent.toml"], "no rig"),
        (["check", source, "--set", "twin.seed=2"], "cannot be changed"),
        (["check", source, "--move"], "nothing of"),
        (["check", source, "--as-it-lies"], "can be moved or lit"),
        (["record", source, "--out", tmp_path / "out.toml", *good], "must end in .h5"),
        (["record", source, "--out", out, "--patterns", tmp_path / "wrong.npy", "--sample", "board"], "takes uint8"),
        (["record", source, "--out", out, "--patterns", tmp_path / "text.npy", "--sample", "board"], "cannot be read"),
        (["record", source, "--out", out, "--patterns", tmp_path / "none.npy", "--sample", "board"], "cannot be read"),
        (["record", source, "--out", out, *good, "--z-mm", "9"], "outside its limits"),
        (["record", source, "--out", out, *good, "--exposure-us", "1"], "outside its limits"),
        (["record", source, "--out", out, "--patterns", tmp_path / "patterns.npy", "--sample", "cat"], "no capture"),
        (["replay", tmp_path / "patterns.npy"], "it is not HDF5"),
        (["replay", tmp_path / "absent.h5"], "there is no"),
    ]
    before = sorted(tmp_path.iterdir())
    for arguments, expected in cases:
        code, _, errors = greenough(*arguments)
        assert code == 2, arguments
        assert expected in errors
        assert errors.count("\n") == 1
    assert sorted(tmp_path.iterdir()) == before


def test_replay_notices_a_damaged_frame(greenough, source: Path) -> None:
    content = bytearray(source.read_bytes())
    stack = open_rig(source)
    stack.operator.place(Placement("board"))
    pixels = np.load(source.parent / "patterns.npy")
    where = content.index(stack.capture(pixels).stack.tobytes())
    content[where + 5] ^= 1
    source.write_bytes(content)
    code, _, errors = greenough("replay", source)
    assert code == 2
    assert "checksum of captures/000000/stack is wrong" in errors
