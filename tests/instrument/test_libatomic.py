"""Claims about the stand-in for libatomic: the loader takes it for the library, and it exchanges 16 bytes."""

import ctypes
import platform
import subprocess
import sys

import pytest

from greenough.instrument import libatomic
from greenough.instrument.errors import InputError

x86_64 = pytest.mark.skipif(platform.machine() != "x86_64", reason="the stand-in is for x86-64")


@pytest.fixture
def exchange(tmp_path):
    """The function of the stand-in, whatever the operating system has: pointer, expected, desired halves, orders."""
    file = tmp_path / "stand-in.so"
    content = libatomic.shared_library()
    # Under another name, the loader cannot mistake a libatomic that is already loaded for it.
    file.write_bytes(content.replace(b"libatomic.so.1\0", b"standin.so.123\0"))
    function = getattr(ctypes.CDLL(str(file)), libatomic.FUNCTION)
    function.restype = ctypes.c_bool
    function.argtypes = [ctypes.c_void_p, ctypes.c_void_p, ctypes.c_uint64, ctypes.c_uint64, ctypes.c_int, ctypes.c_int]
    return function


def aligned(low: int, high: int):
    """Two 64-bit numbers at an address that is a multiple of 16, and what keeps them."""
    kept = (ctypes.c_uint64 * 4)()
    pair = (ctypes.c_uint64 * 2).from_buffer(kept, -ctypes.addressof(kept) % 16)
    pair[:] = [low, high]
    return pair


@x86_64
def test_an_expected_value_is_exchanged(exchange):
    value, expected = aligned(2**63 + 1, 2), aligned(2**63 + 1, 2)
    assert exchange(ctypes.addressof(value), ctypes.addressof(expected), 3, 2**64 - 1, 5, 5)
    assert list(value) == [3, 2**64 - 1]
    assert list(expected) == [2**63 + 1, 2]


@x86_64
@pytest.mark.parametrize("other", [(1, 2), (2**63 + 1, 0)])
def test_another_value_stays_and_is_told(exchange, other):
    value, expected = aligned(*other), aligned(2**63 + 1, 2)
    assert not exchange(ctypes.addressof(value), ctypes.addressof(expected), 3, 4, 5, 5)
    assert list(value) == list(other)
    assert list(expected) == list(other)


PROGRAM = """
import ctypes, sys
from greenough.instrument import libatomic

load = ctypes.CDLL


def without(name, *arguments, **options):
    if name == libatomic.NAME:
        raise OSError
    return load(name, *arguments, **options)


ctypes.CDLL = without
libatomic.ensure_libatomic()
ctypes.CDLL = load
import drjit as dr
from drjit.scalar import Array3f

with open("/proc/self/maps") as maps:
    loaded = {line.split(maxsplit=5)[5].strip() for line in maps if "libatomic" in line}
assert loaded == {"/memfd:libatomic.so.1 (deleted)"}, loaded
print(dr.sum(Array3f(1, 2, 3)))
"""


@x86_64
def test_dr_jit_takes_it_for_the_library():
    """In a process of its own, which pretends that the operating system has none."""
    run = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, timeout=120)
    assert run.returncode == 0, run.stderr
    assert run.stdout.strip() == "6.0"


def test_other_machines_are_told_what_to_install(monkeypatch):
    def missing(name, *arguments, **options):
        raise OSError(name)

    monkeypatch.setattr(libatomic.ctypes, "CDLL", missing)
    monkeypatch.setattr(libatomic.platform, "machine", lambda: "aarch64")
    monkeypatch.setattr(libatomic.sys, "platform", "linux")
    libatomic.ensure_libatomic.cache_clear()
    try:
        with pytest.raises(InputError, match=r'lacks: run "apt-get install libatomic1"'):
            libatomic.ensure_libatomic()
    finally:
        libatomic.ensure_libatomic.cache_clear()
