"""Files that are either whole or absent, and the questions whether they can be written that are asked beforehand."""

import errno
import hashlib
import os
import secrets
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from .errors import FileError, InputError
from .file_errors import cannot_read, cannot_write, reading, refusal_of

_BLOCK = 1 << 20
_STEM = 40  # characters of a name that a temporary one keeps, so that it is not too long where the name is not


@contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """A temporary path beside ``path`` that takes its name on success and is removed on failure.

    The temporary name keeps the suffix of ``path``, since some writers choose the format by it. The body must write
    and close the file.

    Yields
    ------
    Path
        Where to write. Nothing exists there yet.

    Raises
    ------
    FileError
        When no file can be written at ``path``: before the body, or when the operating system refuses it there.
    """
    path = Path(path)
    check_file(path)
    temporary = _temporary(path)
    try:
        yield temporary
        os.replace(temporary, path)
    except InputError:
        raise
    except Exception as error:
        refusal = refusal_of(error, temporary, path)
        if refusal is None:
            raise
        _remove(temporary)  # before what is left is counted
        raise cannot_write(path, refusal) from None
    finally:
        _remove(temporary)


def check_file(path: str | Path) -> None:
    """Ask whether a file can be written at ``path``, by making one beside it and removing that again.

    Raises
    ------
    FileError
        When it cannot, or when there is something that is no file.
    """
    path = Path(path)
    try:
        mode = os.stat(path).st_mode
        if not stat.S_ISREG(mode):
            if stat.S_ISDIR(mode):
                raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
            raise FileError(f"cannot write {path}: it is a device or a pipe; name a file")
    except FileNotFoundError:
        pass
    except OSError as error:
        raise cannot_write(path, error) from None
    _probe(path, path)


def check_folder(path: str | Path) -> None:
    """Ask whether files can be written in a folder, which need not exist, nor those that it lies in.

    Raises
    ------
    FileError
        When they cannot, or when it or one of those that it lies in is a file.
    """
    path = folder = Path(path)
    try:
        while not _exists(folder):
            folder = folder.parent
    except OSError as error:
        raise cannot_write(path, error) from None
    if not folder.is_dir():
        raise _is_a_file(path, folder)
    _probe(folder / "file", path)


def make_folder(path: str | Path) -> None:
    """Make a folder for files, and those that it lies in, as far as they are not there.

    Raises
    ------
    FileError
        When it cannot be made, when files cannot be written in it, or when it is a file.
    """
    path = Path(path)
    check_folder(path)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise cannot_write(path, error) from None


def check_readable(path: str | Path, missing: str) -> None:
    """Ask whether there is a file that can be opened; what is in it is not looked at.

    Parameters
    ----------
    path : str or Path
    missing : str
        The sentence for a file that is not there.

    Raises
    ------
    FileError
        When it is a folder, or may not be read.
    InputError
        With ``missing``.
    """
    path = Path(path)
    try:
        mode = os.stat(path).st_mode
    except FileNotFoundError:
        raise InputError(missing) from None
    except OSError as error:
        raise cannot_read(path, error) from None
    if stat.S_ISDIR(mode):
        raise cannot_read(path, IsADirectoryError(errno.EISDIR, ""))
    if not stat.S_ISREG(mode):
        raise FileError(f"cannot read {path}: it is a device or a pipe; name a file")
    with reading(path), open(path, "rb"):
        pass


def sha256_of_file(path: str | Path) -> str:
    """SHA-256 of a file's bytes as 64 hexadecimal digits, read block by block.

    Raises
    ------
    FileError
        When it cannot be read.
    """
    digest = hashlib.sha256()
    with reading(path), open(path, "rb") as file:
        while block := file.read(_BLOCK):
            digest.update(block)
    return digest.hexdigest()


def _temporary(path: Path) -> Path:
    return path.parent / f".{path.stem[:_STEM]}.{secrets.token_hex(4)}{path.suffix}"


def _probe(path: Path, told: Path) -> None:
    """Make and remove a file beside ``path``; what is refused is told of ``told``."""
    temporary = _temporary(path)
    try:
        os.close(os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666))
    except OSError as error:
        raise cannot_write(told, error) from None
    finally:
        _remove(temporary)


def _exists(folder: Path) -> bool:
    """Also where nobody may look, or a part of it is a file, raises OSError."""
    try:
        os.stat(folder)
    except (FileNotFoundError, NotADirectoryError):
        return False
    return True


def _is_a_file(path: Path, found: Path) -> FileError:
    what = "it is a file" if found == path else f"{found} is a file"
    return FileError(f"cannot write in the folder {path}: {what} and not a folder; name another place")


def _remove(temporary: Path) -> None:
    with suppress(OSError):
        temporary.unlink(missing_ok=True)
