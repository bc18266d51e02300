import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from greenough.instrument.contract import Frames, Placement, Rig
from greenough.instrument.errors import InputError
from greenough.instrument.journal import Placed, describe, events_from_json, to_json
from greenough.instrument.recording import record
from greenough.instrument.replay import open_recording

PLACEMENTS = [
    Placement("board"),
    Placement("board", posture=3),
    Placement("board", face="blank"),
    Placement("coin", unit="um", pose_mm_deg=(0.1, -0.0, 0.3, 1e-7, 5.0, 6.0)),
    Placement("coin"),
    Placement("coin", material="metal"),
]

# What a program may ask of a rig: few values, so that the same is asked more than once.
asked = st.lists(
    st.one_of(
        st.tuples(st.just("place"), st.sampled_from(PLACEMENTS)),
        st.tuples(st.just("move"), st.sampled_from([-1.45, 0.1 + 0.2, 1 / 3])),
        st.tuples(st.just("expose"), st.sampled_from([8333.4, 20_000.0, 1e5 / 3])),
        st.tuples(st.just("capture"), st.integers(1, 3)),
    ),
    max_size=25,
)


def answers(rig: Rig, script: list[tuple[str, Any]], patterns: np.ndarray) -> list[Any]:
    """Everything a rig says while it is asked what the script holds."""
    said: list[Any] = [rig.stage.position_mm, rig.camera.exposure_us]
    for verb, value in script:
        if verb == "place":
            rig.operator.place(value)
        elif verb == "move":
            rig.stage.move_to_mm(value)
            said.append(rig.stage.position_mm)
        elif verb == "expose":
            rig.camera.exposure_us = value
            said.append(rig.camera.exposure_us)
        else:
            said.append(rig.capture(patterns[:value]))
    return said


def bits(answer: Any) -> Any:
    if not isinstance(answer, Frames):
        return answer
    arrays = (answer.stack, answer.serials, answer.times_s)
    exact = [(array.dtype.str, array.shape, array.tobytes()) for array in arrays]
    empty = np.zeros(0)
    return exact, replace(answer, stack=empty, serials=empty, times_s=empty).__repr__()


def test_what_was_recorded_before_placements_had_materials_is_read():
    placed = Placed(Placement("part.stl", unit="um"))
    (older,) = json.loads(to_json([placed]))
    del older["placement"]["material"]
    assert events_from_json(json.dumps([older]), "a recording") == [placed]


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
@settings(max_examples=30)
@given(script=asked)
def test_a_replay_answers_bit_by_bit_as_the_rig_did(
    tmp_path_factory: pytest.TempPathFactory, fake_rig, dtype, script
) -> None:
    path = tmp_path_factory.mktemp("round") / "rig.h5"
    patterns = np.random.default_rng(2).integers(0, 256, (3, *fake_rig().projector.shape), dtype=np.uint8)
    # A part of which nothing is captured is refused by a replay, so every script ends by capturing.
    script = [step for placed in PLACEMENTS for step in (("place", placed), ("capture", 1))] + script
    plain = [bits(answer) for answer in answers(fake_rig(dtype), script, patterns)]
    with record(fake_rig(dtype), path) as rig:
        assert [bits(answer) for answer in answers(rig, script, patterns)] == plain
    with open_recording(path) as rig:
        assert [bits(answer) for answer in answers(rig, script, patterns)] == plain


@pytest.fixture
def recording(tmp_path: Path, fake_rig, patterns) -> Path:
    path = tmp_path / "rig.h5"
    with record(fake_rig(), path) as rig:
        for placement in PLACEMENTS[:3]:
            rig.operator.place(placement)
            rig.capture(patterns)
        rig.capture(patterns)
    return path


def test_a_recording_tells_everything_that_the_rig_told(recording: Path, fake_rig) -> None:
    assert describe(open_recording(recording)) == describe(fake_rig())


def test_an_infinite_full_scale_survives(tmp_path: Path, fake_rig, patterns) -> None:
    rig = fake_rig(np.float32)
    rig.camera.full_scale_dn = np.inf
    with record(rig, tmp_path / "rig.h5") as recorded:
        recorded.capture(patterns)
    replayed = open_recording(tmp_path / "rig.h5")
    assert replayed.camera.full_scale_dn == np.inf
    assert replayed.capture(patterns).full_scale_dn == np.inf


def test_what_was_not_recorded_is_refused_with_what_was(recording: Path, patterns) -> None:
    rig = open_recording(recording)
    with pytest.raises(InputError, match="no capture of coin; it holds board, board in posture 3, board on its blank"):
        rig.operator.place(Placement("coin"))
    rig.operator.place(PLACEMENTS[1])
    with pytest.raises(InputError, match="no further capture of board in posture 3 at 0 mm and 8333 us with these 4"):
        rig.capture(patterns[::-1])
    rig.capture(patterns)
    with pytest.raises(InputError, match="no further capture"):
        rig.capture(patterns)
    rig.stage.move_to_mm(0.5)
    with pytest.raises(InputError, match=r"at 0\.5 mm .* the nearest it has of it: 0 mm and 8333 us \(1 captures\)"):
        rig.capture(patterns)


def test_the_last_bit_of_a_height_does_not_matter(tmp_path: Path, fake_rig, patterns) -> None:
    with record(fake_rig(), tmp_path / "rig.h5") as rig:
        rig.stage.move_to_mm(0.3)
        frames = rig.capture(patterns)
    replayed = open_recording(tmp_path / "rig.h5")
    replayed.stage.move_to_mm(0.1 + 0.2)
    assert bits(replayed.capture(patterns)) == bits(frames)


def test_a_resumed_run_goes_on_behind_its_last_exposure(tmp_path: Path, fake_rig, patterns) -> None:
    with record(fake_rig(), tmp_path / "rig.h5") as rig:
        recorded = [rig.capture(patterns) for _ in range(3)]
    for done in range(4):
        rig = open_recording(tmp_path / "rig.h5", exposures_done=done * len(patterns))
        assert [bits(rig.capture(patterns)) for _ in range(3 - done)] == [bits(frames) for frames in recorded[done:]]
        with pytest.raises(InputError, match="no further capture"):
            rig.capture(patterns)


@settings(max_examples=150)
@given(data=st.data())
def test_a_damaged_recording_is_refused_or_gives_the_same_frames(
    tmp_path_factory: pytest.TempPathFactory, fake_rig, data
) -> None:
    path = tmp_path_factory.mktemp("damage") / "rig.h5"
    patterns = np.zeros((1, *fake_rig().projector.shape), np.uint8)
    with record(fake_rig(), path) as rig:
        frames = rig.capture(patterns)
    content = bytearray(path.read_bytes())
    position = data.draw(st.integers(0, len(content) - 1))
    if data.draw(st.booleans(), label="truncate"):
        content = content[:position]
    else:
        content[position] ^= data.draw(st.integers(1, 255))
    path.write_bytes(content)
    refused = None
    found = None
    try:
        found = open_recording(path).capture(patterns)
    except InputError as error:
        refused = str(error)
    assert (refused is not None and str(path) in refused) or bits(found) == bits(frames)


def test_a_replay_needs_neither_twin_nor_pipeline(recording: Path) -> None:
    script = """
import sys
for absent in ("twin", "pipeline", "scenes"):
    sys.modules[f"greenough.{absent}"] = None
from greenough.instrument import open_rig, Placement
import numpy as np
with open_rig(sys.argv[1]) as rig:
    rig.operator.place(Placement("board"))
    print(rig.identity.name, *rig.camera.shape)
"""
    done = subprocess.run([sys.executable, "-c", script, recording], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["fake", "12", "16"]
