"""What the operating system says when a file cannot be read or written, as sentences with the cause and a remedy.

A cause is named only where the operating system named it: every sentence follows from an ``errno``.
"""

import errno
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from .errors import FileError, InputError

OF_DISKS = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EIO})
"""What only reading and writing can meet, so that it is told even where the error does not name a file."""

_ELSEWHERE = "name another place"
_CAUSES = {
    errno.EDQUOT: ("your quota of disk space is used up", "remove files of yours, or name another place"),
    errno.EFBIG: (
        "a file may not become so large here",
        "raise the limit of this shell (ulimit -f), or name a place on another file system",
    ),
    errno.EROFS: ("its file system is read-only", _ELSEWHERE),
    errno.EIO: ("its disk reports an input/output error", "check the disk, or name another place"),
    errno.ELOOP: ("its symbolic links lead in a circle", _ELSEWHERE),
    errno.EMFILE: ("this process has too many files open", "raise the limit of this shell (ulimit -n)"),
    errno.ENFILE: ("this machine has too many files open", "end other programs, then try again"),
}


def errno_of(error: BaseException) -> int | None:
    """What the operating system said, be it in the text of an error of HDF5 alone; None where it said nothing."""
    if isinstance(error, OSError) and error.errno is not None:
        return error.errno
    told = re.search(r"\berrno = (\d+)", str(error))
    return int(told[1]) if told else None


def cannot_write(path: str | Path, error: BaseException) -> FileError:
    """The sentence for a file, or folder, that could not be written because of ``error``, which has an errno."""
    path, number = Path(path), errno_of(error)
    if number == errno.ENOSPC:
        cause, remedy = _full(path), "free some space, or name another place"
    elif number in (errno.EACCES, errno.EPERM):
        cause, remedy = f"you may not write in the folder {path.parent}", "change its permissions, or name another"
    elif number == errno.EISDIR:
        cause, remedy = "it is a folder", "name a file"
    else:
        cause, remedy = _cause(path, number, "create it first")
    return FileError(f"cannot write {path}: {cause}; {remedy}")


def cannot_read(path: str | Path, error: BaseException, called: str | None = None) -> FileError:
    """The sentence for a file, or folder, that could not be read because of ``error``, which has an errno.

    It is ``called`` by its path unless that is said otherwise.
    """
    path, number = Path(path), errno_of(error)
    if number in (errno.EACCES, errno.EPERM):
        cause, remedy = "you may not read it", "change its permissions, or those of its folder"
    elif number == errno.EISDIR:
        cause, remedy = "it is a folder", "name a file"
    elif number == errno.EIO:
        cause, remedy = "its disk reports an input/output error", "check the disk, or take a copy of the file"
    elif number == errno.ENOENT and path.parent.is_dir():
        cause, remedy = "there is no such file", "name one that exists"
    else:
        cause, remedy = _cause(path, number, "name a file that exists")
    return FileError(f"cannot read {called or path}: {cause}; {remedy}")


def cannot_use(error: OSError) -> FileError | None:
    """The sentence for an error of which it is not known what was being done; None where it is not one of files."""
    if isinstance(error.filename, str | os.PathLike) and error.errno is not None:
        cause = _full(Path(error.filename)) if error.errno == errno.ENOSPC else f"{error.strerror}".lower()
        return FileError(f"cannot use {error.filename}: {cause}; remove the cause, or name another place")
    if error.errno in OF_DISKS:
        return FileError(f"cannot go on: {error.strerror}".rstrip() + "; remove the cause, then try again")
    if f"{error.strerror}".startswith("No usable temporary directory"):
        return FileError("there is no folder for temporary files: make one, and name it by the variable TMPDIR")
    return None


@contextmanager
def reading(path: str | Path) -> Iterator[None]:
    """Turn what the operating system refuses in the body, which reads ``path``, into a sentence.

    Raises
    ------
    FileError
    """
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        if not (isinstance(error, OSError) and error.errno is not None):
            raise
        named = error.filename if isinstance(error.filename, str) else path
        raise cannot_read(named, error) from None


def refusal_of(error: BaseException, *paths: Path) -> BaseException | None:
    """What in the chain of an error says that one of these paths could not be written; None where nothing does.

    Many writers raise another error while they clean up after the first.
    """
    names = {os.fspath(path) for path in paths}
    seen: BaseException | None = error
    while seen is not None:
        if isinstance(seen, OSError) and seen.errno is not None:
            named = seen.filename
            if (named is None and seen.errno in OF_DISKS) or (
                isinstance(named, str | os.PathLike) and os.fspath(named) in names
            ):
                return seen
        seen = seen.__cause__ or seen.__context__
    return None


def _cause(path: Path, number: int | None, for_missing: str) -> tuple[str, str]:
    if number == errno.ENAMETOOLONG:
        return (
            f"its name ({len(os.fsencode(path.name))} bytes) or its whole path is too long",
            "choose a shorter one",
        )
    if number in (errno.ENOENT, errno.ENOTDIR):
        missing = _first_missing(path)
        if missing.exists():
            return f"{missing} is a file and not a folder", _ELSEWHERE
        return f"there is no folder {missing}", for_missing
    cause, remedy = _CAUSES.get(number or 0, (os.strerror(number or 0).lower(), _ELSEWHERE))
    return cause, remedy


def _first_missing(path: Path) -> Path:
    """The uppermost folder of a path that is not there, or no folder."""
    folder = path.parent
    while not folder.parent.is_dir():
        folder = folder.parent
    return folder


def _full(path: Path) -> str:
    """How full the file system of a path is, of which the operating system said that it has no space left."""
    folder = path.parent
    while not os.path.isdir(folder) and folder != folder.parent:
        folder = folder.parent
    try:
        space = os.statvfs(folder)
    except OSError:
        return "the disk is full"
    if space.f_files and not space.f_favail:
        return "the disk is full (its file system can hold no more files)"
    return f"the disk is full ({_size(space.f_bavail * space.f_frsize)} left on its file system without this file)"


def _size(number: int) -> str:
    for factor, unit in ((10**9, "GB"), (10**6, "MB"), (10**3, "kB")):
        if number >= factor:
            return f"{number / factor:.3g} {unit} are"
    return f"{number} bytes are"
