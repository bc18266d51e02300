"""Bitmaps of all depths, against OpenCV as an independent reader and writer."""

from contextlib import suppress

import cv2
import numpy as np
import pytest

from greenough.instrument.lightcrafter_bitmap import BadBitmap, bitmap_bytes, decode_bitmap, encode_bitmap

DLP3000 = (684, 608)
SIZES = {
    1: 52046,
    2: 208006,
    3: 208022,
    4: 208054,
    5: 416054,
    6: 416182,
    7: 416438,
    8: 416950,
}  # that TI's software has


def levels_of(shape: tuple[int, int], depth: int, seed: int = 3) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 2**depth, shape, dtype=np.uint8)


def grey_of(levels: np.ndarray, depth: int) -> np.ndarray:
    return np.rint(levels * (255 / (2**depth - 1))).astype(np.uint8)


@pytest.mark.parametrize("depth", SIZES)
def test_files_have_the_size_that_the_device_expects_back(depth: int) -> None:
    assert len(encode_bitmap(levels_of(DLP3000, depth), depth)) == bitmap_bytes(DLP3000, depth) == SIZES[depth]


@pytest.mark.parametrize("depth", SIZES)
@pytest.mark.parametrize("shape", [DLP3000, (5, 7), (3, 33), (1, 1)])
def test_another_reader_sees_the_image(depth: int, shape: tuple[int, int]) -> None:
    levels = levels_of(shape, depth)
    file = encode_bitmap(levels, depth)
    seen = cv2.imdecode(np.frombuffer(file, np.uint8), cv2.IMREAD_GRAYSCALE)
    np.testing.assert_array_equal(seen, grey_of(levels, depth))
    np.testing.assert_array_equal(decode_bitmap(file, shape, depth), grey_of(levels, depth))


def test_the_file_of_another_writer_is_read() -> None:
    grey = levels_of(DLP3000, 8)
    written, file = cv2.imencode(".bmp", grey)
    assert written
    np.testing.assert_array_equal(decode_bitmap(file.tobytes(), DLP3000, 8), grey)


def test_8_bit_patterns_pass_unchanged() -> None:
    levels = levels_of(DLP3000, 8)
    np.testing.assert_array_equal(decode_bitmap(encode_bitmap(levels, 8), DLP3000, 8), levels)


def test_levels_beyond_the_depth_are_refused() -> None:
    with pytest.raises(ValueError, match="end at 3, not at 4"):
        encode_bitmap(np.full((2, 2), 4, np.uint8), 2)


@pytest.mark.parametrize(
    ("offset", "value"),
    [
        (0, b"PM"),
        (10, b"\x37"),
        (14, b"\x0c"),
        (18, b"\x08"),
        (22, b"\x01"),
        (28, b"\x18"),
        (30, b"\x01"),
        (46, b"\x05"),
    ],
    ids=["magic", "pixels elsewhere", "header", "cols", "rows", "bits", "compressed", "colours"],
)
def test_files_that_say_something_else_are_refused(offset: int, value: bytes) -> None:
    file = bytearray(encode_bitmap(levels_of((5, 7), 8), 8))
    file[offset : offset + len(value)] = value
    with pytest.raises(BadBitmap):
        decode_bitmap(bytes(file), (5, 7), 8)


def test_a_palette_with_colours_is_refused() -> None:
    file = bytearray(encode_bitmap(levels_of((5, 7), 8), 8))
    file[54] = 1
    with pytest.raises(BadBitmap, match="colours"):
        decode_bitmap(bytes(file), (5, 7), 8)


@pytest.mark.parametrize("depth", SIZES)
def test_a_damaged_file_is_an_image_or_refused_and_nothing_else(depth: int) -> None:
    whole = encode_bitmap(levels_of((5, 7), depth), depth)
    for position in range(0, len(whole), 1 if depth < 5 else 3):
        for value in (0, 1, 0x7F, 0xFF):
            file = whole[:position] + bytes([value]) + whole[position + 1 :]
            with suppress(BadBitmap):
                assert decode_bitmap(file, (5, 7), depth).shape == (5, 7)
        with pytest.raises(BadBitmap):
            decode_bitmap(whole[:position], (5, 7), depth)
