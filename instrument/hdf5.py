"""HDF5 files that say what they are: a kind, a version, units and a checksum on every dataset.

Any change of a dataset's values, type, shape or units is noticed when it is read. A file that is damaged, truncated or
foreign is refused with one sentence.

Files are written in the format of HDF5 1.10, whose structures carry checksums of their own, and without strings of
variable length, which lie outside of them: the older format lets damage crash the library. So text is an array of its
UTF-8 bytes.
"""

import hashlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from .errors import InputError
from .file_errors import cannot_read, errno_of, reading
from .files import atomic_path, check_readable
from .hdf5_medium import Medium
from .signals import signals_held

# What h5py raises on a damaged file depends on which structure is hit.
_UNREADABLE = (OSError, RuntimeError, KeyError, ValueError, TypeError, AttributeError, IndexError, MemoryError)


class _Written(h5py.File):
    """A file that is being written, and what it is written to."""

    medium: Medium


@contextmanager
def create(path: str | Path, kind: str, version: int) -> Iterator[h5py.File]:
    """A new file that takes its name once the body has ended without an exception.

    Signals that end the program wait until what is being written is written.

    Raises
    ------
    FileError
        When nothing can be written at ``path``, or no more: at the next `put` or at the end.
    """
    with atomic_path(path) as temporary, Medium(temporary) as medium:
        with signals_held():
            file = _Written(medium, "w", libver=("v110", "v110"))
            file.medium = medium
        try:
            file.attrs["kind"] = np.bytes_(kind)
            file.attrs["version"] = version
            yield file
        finally:
            with signals_held():
                file.close()


@contextmanager
def read(path: str | Path, kind: str, version: int) -> Iterator[h5py.File]:
    """An existing file of this kind and version, open for reading.

    Raises
    ------
    InputError
        When there is no such file, or it cannot be read, or is damaged, truncated, of another kind or of a later
        version.
    """
    path = Path(path)
    check_readable(path, missing=f"there is no {kind} {path}")
    try:
        file = h5py.File(path, "r")
    except OSError as error:
        if errno_of(error) is not None:
            raise cannot_read(path, error) from None
        reason = "is truncated or damaged" if _has_signature(path) else f"is not a {kind}: it is not HDF5"
        raise InputError(f"{path} {reason}") from None
    with file:
        try:
            found, found_version = file.attrs.get("kind"), file.attrs.get("version")
        except _UNREADABLE:
            raise InputError(f"{path} is damaged: its header cannot be read") from None
        found = found.decode(errors="replace") if isinstance(found, bytes) else None
        if found != kind:
            raise InputError(f"{path} is not a {kind}" + (f" but a {found}" if found else ""))
        if found_version != version:
            raise InputError(f"{path} is a {kind} of version {found_version}; this program reads version {version}")
        yield file


def kind_of(path: str | Path) -> str | None:
    """What a file written by `create` says it is; None for any other file and where there is none."""
    if not Path(path).is_file() or not _has_signature(Path(path)):
        return None
    try:
        with h5py.File(path, "r") as file:
            kind = file.attrs.get("kind")
    except _UNREADABLE:
        return None
    return kind.decode(errors="replace") if isinstance(kind, bytes) else None


def put(file: h5py.File, name: str, values: np.ndarray | str, units: str) -> None:
    """Write one dataset with its units ("1" for numbers without) and checksum.

    Raises
    ------
    OSError
        When the file cannot be written any more; `create` makes a sentence of it.
    """
    if isinstance(values, str):
        values = np.frombuffer(values.encode(), np.uint8)
    values = np.asarray(values, order="C")
    with signals_held():
        dataset = file.create_dataset(name, data=values)
        dataset.attrs["units"] = np.bytes_(units)
        dataset.attrs["sha256"] = np.bytes_(_digest(values, units))
    if isinstance(file, _Written):
        file.medium.check()


def get(file: h5py.File, name: str) -> np.ndarray:
    """Read an array written by ``put``.

    Raises
    ------
    InputError
        When it is missing or damaged, or cannot be read.
    """
    try:
        dataset: Any = file[name]
        values = np.asarray(dataset[()], order="C")
        intact = dataset.attrs["sha256"].decode() == _digest(values, dataset.attrs["units"].decode())
    except _UNREADABLE as error:
        if errno_of(error) is not None:
            raise cannot_read(file.filename, error) from None
        raise InputError(f"{file.filename} is damaged: {name} is missing or cannot be read") from None
    if not intact:
        raise InputError(f"{file.filename} is damaged: the checksum of {name} is wrong")
    return values


def get_text(file: h5py.File, name: str) -> str:
    """Read text written by ``put``.

    Raises
    ------
    InputError
        When it is missing or damaged.
    """
    return get(file, name).tobytes().decode()


def _digest(values: np.ndarray, units: str) -> str:
    digest = hashlib.sha256(f"{values.dtype.str} {values.shape} {units} ".encode())
    digest.update(values.reshape(-1).view(np.uint8).data)
    return digest.hexdigest()


def _has_signature(path: Path) -> bool:
    with reading(path), open(path, "rb") as file:
        return file.read(8) == b"\x89HDF\r\n\x1a\n"
