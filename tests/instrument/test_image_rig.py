"""A rig of images keeps of the contract what images can keep."""

import struct
import tracemalloc
import zlib
from importlib import resources
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from greenough.instrument import open_rig
from greenough.instrument.contract import BLANK, Frames, Placement, Rig
from greenough.instrument.errors import InputError
from greenough.instrument.frame_figures import fringe_patterns
from greenough.instrument.recording import record
from greenough.instrument.replay import open_recording

SHAPE = (12, 16)


@pytest.fixture
def folder(image_folder: Path) -> Path:
    return image_folder


def with_bits(folder: Path, bits: int) -> None:
    path = folder / "rig.toml"
    path.write_text(path.read_text().replace("bits = 8", f"bits = {bits}"))


def captured(rig: Rig) -> Frames:
    return rig.capture(fringe_patterns((6, 8), 8.0, 4))


def test_it_says_who_it_is_and_that_no_device_answers(folder: Path) -> None:
    with open_rig(folder / "rig.toml") as rig:
        identity = rig.identity
        assert (identity.name, rig.devices) == ("few", ())
        assert identity.camera_serial
        assert identity.projector_serial
        assert len(bytes.fromhex(identity.settings_sha256)) == 32
        assert rig.camera.noise is None
    changed = open_rig(folder / "rig.toml", ["camera.black_level_dn=5.0"]).identity
    assert changed.settings_sha256 != identity.settings_sha256


def test_the_exposure_is_what_it_was_and_the_stage_goes_as_far_as_there_are_planes(folder: Path) -> None:
    with open_rig(folder / "rig.toml") as rig:
        assert rig.camera.exposure_limits_us == (rig.camera.exposure_us,) * 2
        rig.camera.exposure_us = rig.camera.exposure_us
        for value in (2 * rig.camera.exposure_us, np.nan):
            with pytest.raises(InputError, match="outside"):
                rig.camera.exposure_us = value
        assert rig.stage.limits_mm == (-0.5, 0.5)
        rig.stage.move_to_mm(0.3)
        for value in (0.51, np.nan):
            with pytest.raises(InputError, match="outside"):
                rig.stage.move_to_mm(value)
        assert rig.stage.position_mm == 0.3


def test_each_question_gets_the_frames_of_its_own_place_numbered_on(folder: Path) -> None:
    with open_rig(folder / "rig.toml", run="monday", exposures_done=8) as rig:
        rig.operator.place(Placement("board", posture=0))
        first = captured(rig)
        assert (first.stack == 10).all()
        assert (first.run, first.serials.tolist()) == ("monday", [8, 9, 10, 11])
        assert (first.black_level_dn, first.full_scale_dn) == (4.0, 255.0)
        first.stack[:] = 0
        assert (captured(rig).stack == 10).all()
        rig.operator.place(Placement("board"))
        assert (captured(rig).stack == 20).all()
        rig.operator.place(Placement("board", face=BLANK))
        for height, grey in ((-0.5, 30), (0.0, 40), (0.5, 50)):
            rig.stage.move_to_mm(height)
            frames = captured(rig)
            assert (frames.stack == grey).all()
            assert frames.stage_position_mm == height
        rig.operator.place(Placement(str(folder / "part.npy")))
        assert (captured(rig).stack == 60).all()
        assert captured(rig).serials[0] == 8 + 7 * 4


def test_what_is_not_there_or_was_not_shown_is_refused(folder: Path) -> None:
    with open_rig(folder / "rig.toml") as rig:
        with pytest.raises(InputError, match="nothing was placed"):
            captured(rig)
        rig.operator.place(Placement("board", posture=1))
        with pytest.raises(InputError, match="has no posture 1"):
            captured(rig)
        rig.operator.place(Placement("board"))
        for patterns in (fringe_patterns((6, 8), 8.0, 5), fringe_patterns((6, 8), 4.0, 4)):
            with pytest.raises(InputError, match="nothing is known of"):
                rig.capture(patterns)
        with pytest.raises(InputError, match="patterns are"):
            rig.capture(fringe_patterns((6, 9), 8.0, 4))


@pytest.mark.parametrize(
    ("bits", "dtype", "largest"),
    [(8, np.uint8, 255), (10, np.uint16, 1023), (12, np.uint16, 4095), (16, np.uint16, 65535), (0, np.float32, 1e4)],
)
def test_grey_values_are_those_of_the_cameras_bits(folder: Path, bits: int, dtype: type, largest: float) -> None:
    with_bits(folder, bits)
    for name in ("board1", "board2"):
        np.save(folder / f"{name}.npy", np.full((4, *SHAPE), largest, dtype))
    with open_rig(folder / "rig.toml") as rig:
        rig.operator.place(Placement("board"))
        frames = captured(rig)
        assert frames.stack.dtype == dtype
        assert frames.full_scale_dn == (np.inf if bits == 0 else largest)
        rig.operator.place(Placement("board", face=BLANK))
        if bits != 8:
            with pytest.raises(InputError, match=rf"frames are uint8 up to 40, but camera\.bits = {bits}"):
                captured(rig)


def test_more_grey_than_the_bits_have_is_refused(folder: Path) -> None:
    with_bits(folder, 10)
    np.save(folder / "board2.npy", np.full((4, *SHAPE), 1024, np.uint16))
    with open_rig(folder / "rig.toml") as rig:
        rig.operator.place(Placement("board"))
        with pytest.raises(InputError, match=r"up to 1024, but camera\.bits = 10"):
            captured(rig)


def test_a_picture_that_claims_to_be_huge_costs_no_memory(folder: Path) -> None:
    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = chunk(b"IHDR", struct.pack(">IIBBBBB", 60_000, 60_000, 8, 0, 0, 0, 0))
    (folder / "part.png").write_bytes(b"\x89PNG\r\n\x1a\n" + header + chunk(b"IDAT", b"") + chunk(b"IEND", b""))
    with open_rig(folder / "rig.toml") as rig:
        rig.operator.place(Placement(str(folder / "part.png")))
        tracemalloc.start()
        try:
            with pytest.raises(InputError, match=r"part part\.png: .*claims"):
                captured(rig)
            assert tracemalloc.get_traced_memory()[1] < 20e6
        finally:
            tracemalloc.stop()


def test_it_is_recorded_and_replayed_as_any_rig(folder: Path) -> None:
    with record(open_rig(folder / "rig.toml"), folder / "rec.h5") as rig:
        rig.operator.place(Placement("board"))
        frames = captured(rig)
    with open_recording(folder / "rec.h5") as rig:
        assert rig.camera.noise is None
        rig.operator.place(Placement("board"))
        np.testing.assert_array_equal(captured(rig).stack, frames.stack)


def test_builtin_rigs_are_no_images() -> None:
    rigs = resources.files("greenough.instrument") / "rigs"
    assert all('"images"' not in rig.read_text() for rig in rigs.iterdir() if rig.name.endswith(".toml"))


def test_images_are_found_from_the_rig_file_on(folder: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (folder / "rigs").mkdir()
    text = (folder / "rig.toml").read_text()
    (folder / "rigs/rig.toml").write_text(text.replace('"board{}', '"../board{}').replace('"z{}', '"../z{}'))
    monkeypatch.chdir("/")
    assert open_rig(folder / "rigs/rig.toml").procedure.planes == 2
    Image.new("L", SHAPE[::-1]).save(folder / "board3.npy", format="PNG")  # whatever it is called
    with pytest.raises(InputError, match=r"board3\.npy is not a whole \.npy"):
        open_rig(folder / "rigs/rig.toml")
