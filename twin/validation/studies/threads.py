"""A limit on all threads that computing starts in this process."""

from collections.abc import Iterator
from contextlib import contextmanager

import cv2

from ...renderer import dr


@contextmanager
def threads_limited(n: int) -> Iterator[None]:
    """Keep Dr.Jit and OpenCV to ``n`` threads each, and put back what was before.

    Our own pools of threads are as large as Dr.Jit's.
    """
    before = dr.thread_count(), cv2.getNumThreads()
    dr.set_thread_count(n)
    cv2.setNumThreads(n)
    try:
        yield
    finally:
        dr.set_thread_count(before[0])
        cv2.setNumThreads(before[1])
