"""Frames from anybody's files: images, folders and globs of them, pages of TIFF, and stacks in NumPy's and HDF5 files.

Nothing is allocated before a file's own claim of its size has been held against ``MAX_BYTES`` and, where it is not
compressed, against the file's length.
"""

import io
import re
import warnings
import zipfile
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from glob import glob, has_magic
from pathlib import Path
from typing import IO

import h5py
import numpy as np
from PIL import Image

from .errors import InputError
from .file_errors import cannot_read, errno_of, reading

MAX_BYTES = 4 * 2**30
"""Of all frames together, as they are in memory."""

IMAGES = (".png", ".tif", ".tiff", ".bmp", ".pgm", ".jpg", ".jpeg")
"""What a folder is searched for."""

# What Pillow, NumPy and h5py raise on a damaged file depends on which part of it is hit.
_DAMAGED = (OSError, SyntaxError, ValueError, KeyError, TypeError, IndexError, EOFError, MemoryError)
# zipfile's, of an archive, of its compressed data, of a compression that it has not, and of an encrypted entry.
_DAMAGED_ZIP = (zipfile.BadZipFile, zlib.error, NotImplementedError, RuntimeError)
_GREY_MODES = ("L", "I;16", "I;16B", "I;16L", "I", "F", "1")


@dataclass(frozen=True, eq=False)
class FrameFiles:
    """A stack, (frames, rows, cols), and what each frame was called."""

    stack: np.ndarray
    names: tuple[str, ...]


def natural_key(name: str) -> tuple[tuple[int, int | str], ...]:
    """For sorting names as people count: ``frame2`` before ``frame10``."""
    return tuple((0, int(part)) if part.isdecimal() else (1, part) for part in re.split(r"(\d+)", name) if part)


def read_frames(names: Sequence[str]) -> FrameFiles:
    """All frames of these files.

    Parameters
    ----------
    names : sequence of str
        Images, folders, globs, TIFF files of several pages; or one ``.npy``, ``.npz`` or ``.h5`` file, the last two
        followed by ``:NAME`` where they hold several stacks. Images are grey, of one size and type. What a folder or a
        glob holds is taken in the natural order of its names.

    Raises
    ------
    InputError
        If a file is missing, damaged or too large, or the images do not fit together.
    """
    if len(names) == 1:
        stack = _read_stack(names[0])
        if stack is not None:
            return FrameFiles(stack, tuple(str(number) for number in range(len(stack))))
    images: list[tuple[str, np.ndarray]] = []
    total = 0
    for path in _paths(names):
        for label, image in _pages(path, MAX_BYTES - total):
            images.append((label, image))
            total += image.nbytes
            first_label, first = images[0]
            if image.shape != first.shape or image.dtype != first.dtype:
                raise InputError(
                    f"{label} is {image.shape[1]} x {image.shape[0]} {image.dtype}, but {first_label} is "
                    f"{first.shape[1]} x {first.shape[0]} {first.dtype}; all frames must be alike"
                )
    return FrameFiles(np.stack([image for _, image in images]), tuple(label for label, _ in images))


def _paths(names: Sequence[str]) -> list[Path]:
    paths: list[Path] = []
    for name in names:
        path = Path(name)
        if path.is_dir():
            with reading(path):
                items = list(path.iterdir())
            found = [item for item in items if item.suffix.lower() in IMAGES]
            if not found:
                raise InputError(f"the folder {path} holds no image ({', '.join(IMAGES)})")
        elif path.is_file():
            found = [path]
        elif has_magic(name):
            found = [Path(item) for item in glob(name)]
            if not found:
                raise InputError(f"no file matches {name}")
        else:
            raise InputError(f"there is no file {path}")
        paths += sorted(found, key=lambda item: natural_key(str(item)))
    return paths


def _pages(path: Path, allowed_bytes: int) -> Iterator[tuple[str, np.ndarray]]:
    """Each page of an image file, grey."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # sizes are judged here
        try:
            with reading(path), path.open("rb") as stream, Image.open(stream) as image:
                pages = getattr(image, "n_frames", 1)
                for page in range(pages):
                    image.seek(page)
                    _check_size(path, pages * image.width * image.height * 4, allowed_bytes)
                    yield (path.name if pages == 1 else f"{path.name}, page {page}"), _grey(path, image)
        except Image.DecompressionBombError:
            raise InputError(
                f"{path} claims more pixels than a camera has; give the frames as they were taken"
            ) from None
        except InputError:
            raise
        except _DAMAGED:
            raise InputError(
                f"{path} is not an image, or a damaged one; give PNG or TIFF files, or one .npy, .npz or .h5 file"
            ) from None


def _grey(path: Path, image: Image.Image) -> np.ndarray:
    if image.mode in ("P", "PA"):
        image = image.convert("RGB")
    values = np.asarray(image)
    if image.mode in _GREY_MODES:
        if values.dtype == np.bool_:
            return 255 * values.astype(np.uint8)
        if values.dtype == np.int32 and values.min() >= 0 and values.max() <= 65535:
            return values.astype(np.uint16)
        return values.astype(values.dtype.newbyteorder("="))
    colours = values[..., :3] if image.mode in ("RGB", "RGBA", "RGBX") else values[..., :1]
    if image.mode not in ("RGB", "RGBA", "RGBX", "LA") or (colours != colours[..., :1]).any():
        raise InputError(f"{path} has {values.shape[-1]} channels that differ; give grey images")
    return np.ascontiguousarray(colours[..., 0])


def _read_stack(name: str) -> np.ndarray | None:
    """Of the one file that holds all frames; None where this is an image, a folder or a glob."""
    for suffix, read in ((".npy", _read_npy_file), (".npz", _read_npz), (".h5", _read_hdf5), (".hdf5", _read_hdf5)):
        path, found, item = name.partition(suffix)
        if found and (not item or item.startswith(":")):
            file = Path(path + suffix)
            if file.is_dir():
                return None
            if not file.is_file():
                raise InputError(f"there is no file {file}")
            return read(file, item[1:])
    return None


def _read_npy_file(path: Path, item: str) -> np.ndarray:
    if item:
        raise InputError(f"{path} holds one array: leave out :{item}")
    with reading(path), path.open("rb") as stream:
        return _read_npy(stream, path.stat().st_size, path)


def _read_npy(stream: IO[bytes], available: int, path: Path) -> np.ndarray:
    """One array in NumPy's format, of which there are so many bytes."""
    try:
        header = io.BytesIO(stream.read(min(available, 2**16)))
        version = np.lib.format.read_magic(header)
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, _, dtype = read(header)
        size = int(np.prod([int(length) for length in shape], dtype=object)) * dtype.itemsize
        _check_size(path, size, MAX_BYTES)
        if dtype.kind not in "uif" or size + header.tell() > available:
            raise ValueError
        stream.seek(0)
        return np.lib.format.read_array(stream, allow_pickle=False)
    except InputError:
        raise
    except (*_DAMAGED, *_DAMAGED_ZIP) as error:
        if errno_of(error) is not None:
            raise
        raise InputError(f"{path} is not a whole {path.suffix} file of numbers") from None


def _read_npz(path: Path, item: str) -> np.ndarray:
    try:
        with reading(path), zipfile.ZipFile(path) as archive:
            arrays = {entry.filename.removesuffix(".npy"): entry for entry in archive.infolist()}
            if not item and len(arrays) != 1:
                raise InputError(f"{path} holds {_listed(arrays)}; name one of them as {path}:NAME")
            entry = arrays.get(item or next(iter(arrays)))
            if entry is None:
                raise InputError(f"{path} holds no array {item}, but {_listed(arrays)}")
            _check_size(path, entry.file_size, MAX_BYTES)
            with archive.open(entry) as stream:
                return _read_npy(stream, entry.file_size, path)
    except InputError:
        raise
    except (*_DAMAGED, *_DAMAGED_ZIP):
        raise InputError(f"{path} is not a whole {path.suffix} file of numbers") from None


def _read_hdf5(path: Path, dataset: str) -> np.ndarray:
    stacks: list[str] = []
    try:
        with h5py.File(path, "r") as file:
            if not dataset:
                file.visititems(lambda name, item: stacks.append(name) if getattr(item, "ndim", 0) == 3 else None)
                if len(stacks) != 1:
                    raise InputError(f"{path} holds {_listed(stacks)}; name one of three axes as {path}:DATASET")
                dataset = stacks[0]
            item = file.get(dataset)
            if not isinstance(item, h5py.Dataset):
                raise InputError(f"{path} holds no dataset {dataset}")
            _check_size(path, item.size * item.dtype.itemsize, MAX_BYTES)
            return np.asarray(item[()])
    except InputError:
        raise
    except (*_DAMAGED, RuntimeError) as error:  # the last is HDF5's own
        if errno_of(error) is not None:
            raise cannot_read(path, error) from None
        raise InputError(f"{path} is damaged, truncated or not HDF5") from None


def _listed(names: Sequence[str] | dict) -> str:
    names = list(names)
    if not names:
        return "no stack"
    return f"{len(names)} stacks ({', '.join(names[:3])}{', ...' if len(names) > 3 else ''})"


def _check_size(path: Path, claimed: int, allowed: int) -> None:
    if claimed > allowed:
        raise InputError(
            f"{path} claims {claimed / 2**30:.3g} GiB of frames, and all of them may have {MAX_BYTES / 2**30:.3g} GiB: "
            "crop them, or give fewer"
        )
