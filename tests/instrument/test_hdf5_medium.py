import errno
import os
import signal

import h5py
import numpy as np
import pytest

from greenough.instrument import hdf5, hdf5_medium
from greenough.instrument.errors import FileError
from greenough.instrument.hdf5_medium import Medium

VALUES = np.arange(60_000, dtype=np.float64)


def write(path):
    with hdf5.create(path, "test file", 1) as file:
        for name in "abcd":
            hdf5.put(file, f"group/{name}", VALUES, "mm")


@pytest.fixture
def failing(monkeypatch):
    """Lets the disk take so many bytes and refuse whatever comes after, with this errno."""

    def after(taken: int, number: int) -> None:
        left = [taken]
        pwrite = os.pwrite

        def write_some(file, data, at):
            if left[0] <= 0:
                raise OSError(number, os.strerror(number))
            some = min(len(data), left[0], 4096)  # short writes, as near to the end of a disk
            left[0] -= some
            return pwrite(file, data[:some], at)

        monkeypatch.setattr(hdf5_medium.os, "pwrite", write_some)

    return after


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EIO])
@pytest.mark.parametrize("taken", [0, 8192, 100_000, 481_000, 1_900_000, 1_921_000])
def test_a_disk_that_fails_anywhere_is_one_sentence_and_nothing_is_left(tmp_path, failing, taken, number):
    failing(taken, number)
    with pytest.raises(FileError, match=r"full|input/output error"):
        write(tmp_path / "a.h5")
    assert list(tmp_path.iterdir()) == []
    assert not any(str(tmp_path) in os.readlink(f"/proc/self/fd/{n}") for n in open_files())


def open_files() -> list[str]:
    return [n for n in os.listdir("/proc/self/fd") if os.path.lexists(f"/proc/self/fd/{n}")]


def test_hdf5_itself_reads_what_is_written(tmp_path):
    write(tmp_path / "a.h5")
    with h5py.File(tmp_path / "a.h5", "r") as file:
        assert file.driver == "sec2"
        assert list(file["group"]) == list("abcd")
        for name in "abcd":
            np.testing.assert_array_equal(file[f"group/{name}"], VALUES)


def test_what_could_not_be_written_is_read_back_until_the_end(tmp_path, failing):
    failing(10, errno.ENOSPC)
    medium = Medium(tmp_path / "file")
    medium.write(b"0123456789abcdef")
    medium.seek(4)
    medium.write(b"XY")
    medium.seek(0)
    assert medium.read(20) == b"0123XY6789abcdef\0\0\0\0"
    assert medium.seek(0, os.SEEK_END) == 16
    with pytest.raises(OSError, match="No space left"), medium:
        pass


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interruption_waits_for_the_end_of_a_write(tmp_path, monkeypatch, number):
    came = []

    def end(number, frame):
        came.append("handled")
        raise KeyboardInterrupt

    def write_and_signal(medium, data):
        signal.raise_signal(number)
        came.append("written")
        return write_to(medium, data)

    write_to = Medium.write
    monkeypatch.setattr(Medium, "write", write_and_signal)
    before = signal.signal(number, end)
    try:
        with pytest.raises(KeyboardInterrupt):
            write(tmp_path / "a.h5")
        assert signal.getsignal(number) is end
    finally:
        signal.signal(number, before)
    assert came[0] == "written"
    assert "handled" in came
    assert list(tmp_path.iterdir()) == []
