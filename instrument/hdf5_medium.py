"""What HDF5 writes a file to: the file itself, as long as the operating system takes it.

HDF5 does not survive a write that fails: its file stays half open, errors are printed where nobody can catch them, and
closing may end the process by a segmentation fault. So it never sees one. A failure is kept, and what could not be
written is kept in memory until the file is closed, which must be soon.
"""

import os
from pathlib import Path
from types import TracebackType
from typing import Self


class Medium:
    """A new file for h5py's driver for Python objects; its context closes it and raises what had failed.

    Parameters
    ----------
    path : Path
        Nothing may exist there.

    Raises
    ------
    OSError
        When the file cannot be made; on leaving the context without another exception, what failed first.
    """

    def __init__(self, path: Path):
        self.failure: OSError | None = None
        self._file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o666)
        self._at = self._end = 0
        self._unwritten: list[tuple[int, bytes]] = []

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        try:
            os.close(self._file)
        except OSError as failure:  # network file systems say then that they are full
            self.failure = self.failure or failure
        if error is None:
            self.check()

    def check(self) -> None:
        """Raise the OSError that failed first, if any did."""
        if self.failure is not None:
            raise self.failure

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        """From the beginning, or from the end."""
        self._at = offset if whence == os.SEEK_SET else self._end + offset
        return self._at

    def tell(self) -> int:
        return self._at

    def write(self, data: bytes | memoryview) -> int:
        """All of it, as far as the caller knows."""
        view = memoryview(data).cast("B")
        if self.failure is None:
            try:
                done = 0
                while done < len(view):
                    done += os.pwrite(self._file, view[done:], self._at + done)
            except OSError as failure:
                self.failure = failure
        if self.failure is not None:
            self._unwritten.append((self._at, bytes(view)))
        self._at += len(view)
        self._end = max(self._end, self._at)
        return len(view)

    def read(self, size: int) -> bytes:
        """From the present place, zeros for what cannot be read."""
        buffer = bytearray(size)
        self.readinto(buffer)
        return bytes(buffer)

    def readinto(self, buffer: bytearray | memoryview) -> int:
        """As `read`, into all of ``buffer``."""
        view, start = memoryview(buffer).cast("B"), self._at
        stop = start + len(view)
        try:
            found = os.pread(self._file, len(view), start)
        except OSError as failure:
            self.failure, found = self.failure or failure, b""
        view[:] = found + bytes(len(view) - len(found))
        for at, data in self._unwritten:
            low, high = max(at, start), min(at + len(data), stop)
            if low < high:
                view[low - start : high - start] = data[low - at : high - at]
        self._at = stop
        return len(view)

    def truncate(self, size: int) -> int:
        """Make the file as long as this."""
        self._end = size
        if self.failure is None:
            try:
                os.ftruncate(self._file, size)
            except OSError as failure:
                self.failure = failure
        return size

    def flush(self) -> None:
        """Nothing is buffered here."""
