import errno
import os
from pathlib import Path

import pytest

from greenough.instrument.errors import FileError, InputError
from greenough.instrument.file_errors import cannot_read, cannot_use, cannot_write, errno_of, reading, refusal_of
from greenough.instrument.files import atomic_path, check_file, check_folder, make_folder

FULL = OSError(errno.ENOSPC, "No space left on device")


@pytest.mark.parametrize("number", sorted(errno.errorcode))
def test_every_sentence_names_the_path_and_a_remedy(tmp_path: Path, number: int) -> None:
    path = tmp_path / "cal.h5"
    for tell in (cannot_write, cannot_read):
        sentence = str(tell(path, OSError(number, os.strerror(number))))
        assert str(path) in sentence
        assert sentence.count("; ") == 1
        assert not sentence.endswith(".")
        assert ("disk is full" in sentence) == (number == errno.ENOSPC and tell is cannot_write)


def test_what_hdf5_says_in_words_alone_is_understood() -> None:
    told = RuntimeError("Can't decrement id ref count (file write failed: errno = 28, error message = 'No space')")
    assert errno_of(told) == errno.ENOSPC
    assert errno_of(ValueError("bad")) is None


def test_only_what_a_disk_said_of_this_file_is_told_of_it(tmp_path: Path) -> None:
    path = tmp_path / "cal.h5"
    for error in (FULL, OSError(errno.EACCES, "denied", str(path)), OSError(errno.EIO, "broken")):
        assert refusal_of(error, path) is error
    for error in (ValueError("bug"), OSError(errno.ENOENT, "missing", "/other"), ConnectionResetError(104, "reset")):
        assert refusal_of(error, path) is None
    later = ValueError("cleaning up failed as well")
    later.__context__ = FULL
    assert refusal_of(later, path) is FULL


@pytest.mark.parametrize("error", [OSError(errno.ENOENT, "missing", "/other"), ConnectionResetError(104, "reset")])
def test_what_is_no_failure_of_the_file_passes_through(tmp_path: Path, error: OSError) -> None:
    with pytest.raises(OSError, match=str(error.strerror)) as raised, atomic_path(tmp_path / "a.h5"):
        raise error
    assert raised.value is error


def test_a_full_disk_is_told_of_the_file_and_the_half_is_removed(tmp_path: Path) -> None:
    said = r"cannot write .*a\.h5: the disk is full \(.* left on its file system"
    with pytest.raises(FileError, match=said), atomic_path(tmp_path / "a.h5") as path:
        raise OSError(FULL.errno, f"after {path.write_text('half')} characters")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("check", [check_file, check_folder, make_folder])
def test_asking_leaves_nothing(tmp_path: Path, check) -> None:
    check(tmp_path / "name")
    assert list(tmp_path.iterdir()) == ([tmp_path / "name"] if check is make_folder else [])


def test_devices_are_not_replaced_by_files() -> None:
    with pytest.raises(FileError, match="a device or a pipe; name a file"):
        check_file("/dev/null")


def test_long_names_that_fit_are_written(tmp_path: Path) -> None:
    name = "x" * 250 + ".h5"
    with atomic_path(tmp_path / name) as path:
        path.write_text("whole")
    assert (tmp_path / name).read_text() == "whole"
    with pytest.raises(FileError, match=r"its name \(260 bytes\)|its name of 260 bytes"):
        check_file(tmp_path / ("x" * 257 + ".h5"))


@pytest.mark.parametrize("make", [check_folder, make_folder])
def test_a_file_in_place_of_a_folder_is_told(tmp_path: Path, make) -> None:
    (tmp_path / "file").write_text("")
    for path, said in ((tmp_path / "file", "it is a file"), (tmp_path / "file" / "below", "file is a file")):
        with pytest.raises(FileError, match=f"{said} and not a folder; name another place"):
            make(path)


def test_reading_tells_what_the_operating_system_said_and_nothing_else(tmp_path: Path) -> None:
    with pytest.raises(FileError, match="it is a folder"), reading(tmp_path):
        tmp_path.read_bytes()
    with pytest.raises(InputError, match="its own"), reading(tmp_path):
        raise InputError("its own")
    with pytest.raises(OSError, match="cannot identify"), reading(tmp_path):
        raise OSError("cannot identify image file")


def test_of_what_nobody_foresaw_only_failures_of_files_are_sentences() -> None:
    assert "cannot use /a/b: is a directory" in str(
        cannot_use(IsADirectoryError(errno.EISDIR, "Is a directory", "/a/b"))
    )
    assert "no space left" in str(cannot_use(FULL)).lower()
    assert "TMPDIR" in str(
        cannot_use(FileNotFoundError(errno.ENOENT, "No usable temporary directory found in ['/tmp']"))
    )
    assert cannot_use(ConnectionResetError(errno.ECONNRESET, "reset")) is None
