import json
import os
from math import pi

import cv2
import h5py
import numpy as np
import pytest
from typer.testing import CliRunner

from greenough.instrument import hdf5
from greenough.instrument.errors import InputError
from greenough.pipeline.decode_command import KIND, VERSION, app
from greenough.pipeline.gray_code import stripe_patterns

COLUMN = np.broadcast_to(np.linspace(5, 590, 120), (8, 120))


@pytest.fixture
def stack():
    """24 frames of the paper's set."""
    images = [
        118 + 84 * np.cos(2 * pi * (COLUMN / period + n / steps))
        for period, steps in ((608, 4), (152, 4), (40, 4), (12, 12))
        for n in range(steps)
    ]
    return np.rint(images).astype(np.uint8)


def decode(*arguments):
    result = CliRunner().invoke(app, [str(argument) for argument in arguments])
    if isinstance(result.exception, InputError):
        raise result.exception
    return result


def write_images(folder, stack, suffix):
    paths = [folder / f"{index:02}{suffix}" for index in range(len(stack))]
    for path, image in zip(paths, stack, strict=True):
        assert cv2.imwrite(str(path), image)
    return paths


def test_images_become_a_phase_map_in_one_file(tmp_path, stack):
    out = tmp_path / "phase.h5"
    result = decode(*write_images(tmp_path, stack, ".png"), "--out", out, "--json")
    assert result.exit_code == 0, result.output
    assert json.loads(result.stdout)["valid_share"] == 1
    with hdf5.read(out, KIND, VERSION) as file:
        np.testing.assert_allclose(hdf5.get(file, "absolute"), 2 * pi * COLUMN / 12, atol=0.02)
        assert hdf5.get(file, "valid").all()


def test_other_sets_are_named_by_periods_and_steps(tmp_path, stack):
    np.save(tmp_path / "stack.npy", stack[4:12])
    out = tmp_path / "phase.h5"
    result = decode(tmp_path / "stack.npy", "--periods", "152,40", "--steps", "4,4", "--out", out)
    assert result.exit_code == 0, result.output
    with hdf5.read(out, KIND, VERSION) as file:
        first_period = (COLUMN > 5) & (COLUMN < 150)
        absolute = hdf5.get(file, "absolute")[first_period]
        np.testing.assert_allclose(absolute, 2 * pi * COLUMN[first_period] / 40, atol=0.03)


def test_frames_of_somebody_else_fall_into_order(tmp_path, stack):
    """Horizontal fringes of another sign and start, the finest period first, steps before periods in the names."""
    row, sets = COLUMN.T, ((12, 12), (40, 4), (152, 4), (608, 4))
    folder = tmp_path / "frames"
    folder.mkdir()
    for k, (period, steps) in enumerate(sets):
        for n in range(steps):
            image = np.rint(118 + 84 * np.sin(2 * pi * (row / period - n / steps))).astype(np.uint8)
            assert cv2.imwrite(str(folder / f"shift{n}_period{k}.png"), image)
    out = tmp_path / "phase.h5"
    options = ["--periods", "12,40,152,608", "--steps", "12,4,4,4", "--direction", "horizontal"]
    result = decode(folder, *options, "--sign", "-1", "--start-deg=-90", "--out", out, "--json")
    answer = json.loads(result.stdout)
    assert answer["valid_share"] == 1
    assert "counts periods" in answer["order"]
    assert answer["frames"][0] == "shift0_period3.png"
    with hdf5.read(out, KIND, VERSION) as file:
        np.testing.assert_allclose(hdf5.get(file, "absolute"), 2 * pi * row / 12, atol=0.02)
        assert file.attrs["direction"] == b"horizontal"


@pytest.mark.parametrize("inverse", [True, False])
def test_a_gray_code_among_the_frames_counts_fringes(tmp_path, inverse):
    fringes = [np.rint(118 + 84 * np.cos(2 * pi * (COLUMN / 20 + n / 3))).astype(np.uint8) for n in range(3)]
    bits = stripe_patterns(600, 20, 5)[:, np.rint(COLUMN).astype(int)]
    bits = [frame for bit in bits for frame in ((bit, 255 - bit) if inverse else (bit,))]
    np.save(tmp_path / "stack.npy", np.stack([bits[0], *fringes, *bits[1:]]))
    numbers = f"0,4-{2 + len(bits)}"
    out = tmp_path / "phase.h5"
    options = ["--periods", "20", "--steps", "3", "--gray-frames", numbers, "--field", "600"]
    result = decode(tmp_path / "stack.npy", *options, *(["--gray-inverse"] if inverse else []), "--out", out, "--json")
    assert json.loads(result.stdout)["valid_share"] > 0.9
    with hdf5.read(out, KIND, VERSION) as file:
        error = hdf5.get(file, "absolute") - 2 * pi * COLUMN / 20
    assert np.nanmax(np.abs(error)) < 0.05


REAL = os.environ.get("GREENOUGH_REAL_FRAMES", "")


@pytest.mark.skipif(
    not REAL, reason="GREENOUGH_REAL_FRAMES is not set: the folder of kamino410/phase-shifting's object1"
)
@pytest.mark.parametrize(
    ("direction", "fringe_frames", "gray_frames", "field"),
    [("vertical", "0-5", "12-21", 1920), ("horizontal", "6-11", "22-29", 1080)],
)
def test_real_frames_of_others_get_orders_that_their_two_codes_agree_on(
    tmp_path, direction, fringe_frames, gray_frames, field
):
    """Three steps bent by gamma: the two periods, 100 and 66.7 columns, must agree where the Gray code puts them."""
    out = tmp_path / "phase.h5"
    options = ["--periods", "66.66666667,100", "--steps", "3,3", "--start-deg=-120", "--direction", direction]
    options += ["--fringe-frames", fringe_frames, "--gray-frames", gray_frames, "--gray-inverse", "--gray-width", "100"]
    decode(REAL, *options, "--field", str(field), "--out", out)
    with hdf5.read(out, KIND, VERSION) as file:
        column = hdf5.get(file, "absolute") * 66.66666667 / (2 * pi)
        valid, modulation = hdf5.get(file, "valid"), hdf5.get(file, "modulation")
    assert valid[modulation > 5].mean() > 0.9
    along = np.diff(column, axis=1 if direction == "vertical" else 0)
    # Half a period is jumped over at the object's outline alone.
    assert np.mean(np.abs(along[np.isfinite(along)]) > 30) < 1e-3


def test_files_that_cannot_be_used_are_refused_and_nothing_is_written(tmp_path, stack):
    paths = write_images(tmp_path, stack, ".png")
    out = tmp_path / "phase.h5"
    (tmp_path / "text.png").write_text("not an image")
    (tmp_path / "empty.png").touch()
    (tmp_path / "cut.npy").write_bytes(b"\x93NUMPY\x01\x00")
    (tmp_path / "text.h5").write_text("not HDF5")
    cv2.imwrite(str(tmp_path / "colour.png"), np.zeros((8, 120, 3), np.uint8) + np.arange(3, dtype=np.uint8))
    cv2.imwrite(str(tmp_path / "small.png"), stack[0, :4])
    with h5py.File(tmp_path / "two.h5", "w") as file:
        file["a"] = file["b"] = stack
    for frames, says in (
        ([tmp_path / "absent.png"], "no file"),
        ([tmp_path / "text.png"], "not an image"),
        ([tmp_path / "empty.png"], "not an image"),
        ([tmp_path / "cut.npy"], "not a whole .npy"),
        ([tmp_path / "text.h5"], "not HDF5"),
        ([tmp_path / "colour.png"], "3 channels"),
        ([*paths[:-1], tmp_path / "small.png"], "120 x 4 uint8"),
        ([tmp_path / "two.h5"], "2 stacks"),
        ([f"{tmp_path}/two.h5:c"], "no dataset c"),
        (paths[:-1], "23 frames"),
        ([*paths, "--periods", "608,x"], "--periods 608,x"),
        ([*paths, "--steps", "4,4,4,12.5"], "whole numbers"),
        ([*paths, "--steps", "4,4,4"], "one number of steps for each period"),
        ([*paths, "--field", "1000", "--periods", "608,304,152,76"], "repeat together every 608"),
        ([*paths, "--gray-frames", "0-3"], "--field"),
        ([*paths, "--gray-frames", "0-2", "--gray-inverse", "--field", "608", "--fringe-frames", "0-23"], "even in"),
        ([*paths, "--sign", "2"], "sign"),
    ):
        with pytest.raises(InputError, match=says):
            decode(*frames, "--out", out)
        assert not out.exists()
    with pytest.raises(InputError, match=r"must end in \.h5"):
        decode(*paths, "--out", tmp_path / "phase.png")
