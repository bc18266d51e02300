import json
from math import pi

import cv2
import h5py
import numpy as np
import pytest
from typer.testing import CliRunner

from greenough.instrument import hdf5
from greenough.instrument.errors import InputError
from greenough.pipeline.decode_command import KIND, VERSION, app, read_stack

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


@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
def test_every_file_format_gives_the_same_stack(tmp_path, stack, kind):
    stack = stack.astype(kind)
    np.save(tmp_path / "stack.npy", stack)
    with h5py.File(tmp_path / "stack.h5", "w") as file:
        file["frames"] = stack
        file["other"] = np.zeros(3)
    for names in (
        [tmp_path / "stack.npy"],
        [tmp_path / "stack.h5"],
        [f"{tmp_path}/stack.h5:frames"],
        write_images(tmp_path, stack, ".png"),
        write_images(tmp_path, stack, ".tiff"),
    ):
        np.testing.assert_array_equal(read_stack([str(name) for name in names]), stack)


def test_files_that_cannot_be_used_are_refused_and_nothing_is_written(tmp_path, stack):
    paths = write_images(tmp_path, stack, ".png")
    out = tmp_path / "phase.h5"
    (tmp_path / "text.png").write_text("not an image")
    (tmp_path / "empty.png").touch()
    (tmp_path / "cut.npy").write_bytes(b"\x93NUMPY\x01\x00")
    (tmp_path / "text.h5").write_text("not HDF5")
    cv2.imwrite(str(tmp_path / "colour.png"), np.zeros((8, 120, 3), np.uint8))
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
    ):
        with pytest.raises(InputError, match=says):
            decode(*frames, "--out", out)
        assert not out.exists()
    with pytest.raises(InputError, match=r"must end in \.h5"):
        decode(*paths, "--out", tmp_path / "phase.png")
