"""The picture of a cloud that does not match shows where, and by how much."""

import numpy as np
import pytest
from PIL import Image

from greenough.pipeline.error_map import write_error_map

SHAPE = (60, 80)


def drawn(path, **options):
    """Of a plane whose left half lies 10 µm too low and whose right half 10 µm too high."""
    rows, cols = np.mgrid[: SHAPE[0], : SHAPE[1]]
    errors = np.where(cols < SHAPE[1] // 2, -10.0, 10.0)
    xyz = np.stack([cols * 0.1, -rows * 0.1, errors * 1e-3], axis=-1).reshape(-1, 3)
    write_error_map(path, xyz, errors.ravel(), 4.0, "a $title_{", **options)
    with Image.open(path) as picture:
        assert picture.format == "PNG"
        return np.asarray(picture.convert("RGB")).astype(int)


PIXELS = np.argwhere(np.ones(SHAPE, bool))


@pytest.mark.parametrize("pixels", [None, PIXELS, PIXELS + 1000, PIXELS.astype(np.int32) * 10_000_000])
def test_low_is_blue_and_left_high_is_red_and_right(tmp_path, pixels):
    picture = drawn(tmp_path / "errors.png", pixels=pixels)
    places = picture[:, : picture.shape[1] // 2]
    red, blue = (places[..., k] > places[..., 2 - k] + 60 for k in (0, 2))
    assert min(red.sum(), blue.sum()) > 5000
    assert np.nonzero(red)[1].mean() > np.nonzero(blue)[1].mean() + 50


@pytest.mark.parametrize("pixels", [None, PIXELS])
def test_the_circle_is_around_the_worst(tmp_path, pixels):
    """Of two pictures that differ in where the worst lies, each is black somewhere where the other is not."""
    pictures = []
    for row, col in ((10, 70), (50, 40)):
        errors = np.zeros(SHAPE)
        errors[row, col] = 5.0
        xyz = np.column_stack([PIXELS[:, 1], -PIXELS[:, 0], errors.ravel()])
        write_error_map(tmp_path / "errors.png", xyz, errors.ravel(), 4.0, "one", pixels)
        with Image.open(tmp_path / "errors.png") as picture:
            half = picture.convert("L").crop((0, 0, picture.width // 2, picture.height))
            pictures.append(np.asarray(half) < 60)
    (upper_row, upper_col), (lower_row, lower_col) = (
        (where.mean() for where in np.nonzero(here & ~there)) for here, there in (pictures, pictures[::-1])
    )
    assert upper_row < lower_row - 100
    assert upper_col > lower_col + 50


def test_errors_that_nobody_knows_are_drawn_as_none(tmp_path):
    write_error_map(tmp_path / "errors.png", np.zeros((5, 3)), np.full(5, np.nan), 4.0, "nothing")
    assert (tmp_path / "errors.png").exists()
