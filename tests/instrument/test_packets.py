"""Arrays for Dr.Jit."""

import subprocess
import sys

import numpy as np
import pytest

from greenough.instrument.packets import ALIGNED_BYTES, LANES, packed

AT_THE_END_OF_A_PAGE = """
import ctypes, mmap
import numpy as np
from greenough.instrument.packets import packed
from greenough.pipeline.jit import Float, dr

n = 4 * mmap.PAGESIZE // 4 - 5
libc = ctypes.CDLL(None)
libc.mmap.restype = ctypes.c_void_p
base = libc.mmap(None, ctypes.c_size_t(5 * mmap.PAGESIZE), 3, 0x22, -1, ctypes.c_long(0))
end = base + 4 * mmap.PAGESIZE
assert libc.mprotect(ctypes.c_void_p(end), ctypes.c_size_t(mmap.PAGESIZE), 0) == 0
values = np.frombuffer((ctypes.c_char * (4 * n)).from_address(end - 4 * n), np.float32)
doubled = 2 * Float(packed(values)) + 1
dr.eval(doubled)
assert (np.array(doubled) == 1).all()
"""


@pytest.mark.skipif(sys.platform != "linux", reason="maps memory with Linux's numbers")
def test_an_array_at_the_end_of_memory_is_computed_with():
    done = subprocess.run([sys.executable, "-c", AT_THE_END_OF_A_PAGE], capture_output=True, check=False)
    assert done.returncode == 0, done.stderr.decode()


@pytest.mark.parametrize("n", [0, 1, LANES - 1, LANES, LANES + 1, 5 * LANES + 3])
@pytest.mark.parametrize("dtype", [np.uint8, np.float32, np.float64])
def test_values_keep_and_the_last_packet_has_room(n, dtype):
    values = np.arange(2 * n, dtype=dtype)[::2]
    room = packed(values)
    np.testing.assert_array_equal(room, values)
    assert room.flags.c_contiguous
    owner = room if room.base is None else room.base
    assert owner.size % LANES == 0


def test_whole_packets_are_not_copied():
    values = np.zeros((3, LANES), np.float32)
    assert np.shares_memory(packed(values), values)


@pytest.mark.parametrize("n", [3 * LANES, 3 * LANES + 1])
@pytest.mark.parametrize("start", range(4))
@pytest.mark.parametrize("dtype", [np.uint8, np.uint32, np.float32])
def test_an_aligned_array_begins_where_a_packet_does_wherever_the_values_lie(n, start, dtype):
    memory = np.zeros(n + 2 * ALIGNED_BYTES, dtype)
    values = memory[start : start + n]
    values[:] = np.arange(n)
    room = packed(values, aligned=True)
    assert room.ctypes.data % ALIGNED_BYTES == 0
    assert room.dtype == dtype
    np.testing.assert_array_equal(room, values)


def test_an_array_that_is_aligned_is_not_copied():
    values = packed(np.zeros(LANES + 1, np.float32))[:LANES]
    assert np.shares_memory(packed(values, aligned=True), values)
