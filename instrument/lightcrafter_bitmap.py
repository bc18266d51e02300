"""The bitmap files in which a LightCrafter takes and gives patterns: grey palettes of 2^depth entries.

Depths 2 to 4 are stored in 4 bits per pixel and depths 5 to 8 in 8 bits, rows from the lowest up, each padded to whole
32-bit words.
"""

import struct

import numpy as np

_HEADER = struct.Struct("<2sIHHI IiiHHIIiiII")  # file header and BITMAPINFOHEADER
_INFO_BYTES = 40


class BadBitmap(ValueError):
    """Bytes that are not such a file."""


def bitmap_bytes(shape: tuple[int, int], depth: int) -> int:
    """Size of the file of an image of ``shape`` (rows, cols) with ``depth`` bits."""
    return _HEADER.size + 4 * 2**depth + shape[0] * _row_bytes(shape[1], _stored_bits(depth))


def encode_bitmap(levels: np.ndarray, depth: int) -> bytes:
    """The file of an image.

    Parameters
    ----------
    levels : (rows, cols) uint8
        From 0, dark, to ``2**depth - 1``.
    depth : int
        1 to 8.

    Raises
    ------
    ValueError
        For levels beyond the depth.
    """
    if levels.size and levels.max() >= 2**depth:
        raise ValueError(f"levels of {depth} bits end at {2**depth - 1}, not at {levels.max()}")
    rows, cols = levels.shape
    bits = _stored_bits(depth)
    pixels = np.zeros((rows, _row_bytes(cols, bits)), np.uint8)
    if bits == 8:
        pixels[:, :cols] = levels[::-1]
    elif bits == 4:
        pairs = np.pad(levels[::-1], ((0, 0), (0, cols % 2)))
        pixels[:, : pairs.shape[1] // 2] = pairs[:, ::2] << 4 | pairs[:, 1::2]
    else:
        packed = np.packbits(levels[::-1], axis=1)
        pixels[:, : packed.shape[1]] = packed
    colours = 2**depth
    offset, size = _HEADER.size + 4 * colours, bitmap_bytes(levels.shape, depth)
    header = _HEADER.pack(
        b"BM", size, 0, 0, offset, _INFO_BYTES, cols, rows, 1, bits, 0, pixels.size, 0, 0, colours, colours
    )
    return header + _grey_palette(depth).tobytes() + pixels.tobytes()


def decode_bitmap(file: bytes, shape: tuple[int, int], depth: int) -> np.ndarray:
    """The grey values that a file of ``shape`` and ``depth`` shows, (rows, cols) uint8 from 0 to 255.

    Raises
    ------
    BadBitmap
        When it is no such file, byte by byte but for what says nothing about the image (resolution, reserved fields).
    """
    if len(file) != bitmap_bytes(shape, depth):
        raise BadBitmap(f"has {len(file)} bytes instead of {bitmap_bytes(shape, depth)}")
    magic, _, _, _, offset, info, cols, rows, planes, bits, compression, _, _, _, colours, _ = _HEADER.unpack_from(file)
    if (magic, info, planes, compression) != (b"BM", _INFO_BYTES, 1, 0):
        raise BadBitmap("is no uncompressed bitmap")
    if (rows, cols) != shape or bits != _stored_bits(depth) or colours not in (0, 2**depth):
        raise BadBitmap(f"has {rows} rows and {cols} columns of {bits} bits with {colours} colours")
    if offset != _HEADER.size + 4 * 2**depth:
        raise BadBitmap(f"has its pixels at {offset}")
    palette = np.frombuffer(file, np.uint8, 4 * 2**depth, _HEADER.size).reshape(-1, 4)
    if (palette[:, :3] != palette[:, :1]).any():
        raise BadBitmap("has colours")
    pixels = np.frombuffer(file, np.uint8, -1, offset).reshape(rows, -1)[::-1]
    if bits == 8:
        levels = pixels[:, :cols]
    elif bits == 4:
        levels = np.stack([pixels >> 4, pixels & 15], axis=-1).reshape(rows, -1)[:, :cols]
    else:
        levels = np.unpackbits(pixels, axis=1)[:, :cols]
    if levels.max(initial=0) >= 2**depth:
        raise BadBitmap("has pixels beyond its palette")
    return palette[levels, 0]


def _stored_bits(depth: int) -> int:
    return {1: 1, 2: 4, 3: 4, 4: 4}.get(depth, 8)


def _row_bytes(cols: int, bits: int) -> int:
    return (cols * bits + 31) // 32 * 4


def _grey_palette(depth: int) -> np.ndarray:
    """Evenly from black to white, (2**depth, 4) uint8: blue, green, red, reserved."""
    palette = np.zeros((2**depth, 4), np.uint8)
    palette[:, :3] = np.rint(np.linspace(0, 255, 2**depth)).astype(np.uint8)[:, None]
    return palette
