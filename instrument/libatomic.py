"""libatomic for Dr.Jit, whose wheel asks the operating system for it without bringing it.

Minimal systems and most container images lack ``libatomic.so.1``, and without it Dr.Jit cannot be imported
(mitsuba-renderer/drjit, issue 484). Dr.Jit calls one function of it, ``__atomic_compare_exchange_16``, which on x86-64
is one instruction, ``lock cmpxchg16b``. No package of pip carries the library, so this module writes a shared library
that holds this function alone and loads it from memory.
"""

import ctypes
import os
import platform
import struct
import sys
from functools import cache

from .errors import InputError

NAME = "libatomic.so.1"
FUNCTION = "__atomic_compare_exchange_16"
VERSION = "LIBATOMIC_1.0"

# bool f(pointer: rdi, expected: rsi, desired: rdx and rcx); its two memory orders are ignored, since the instruction is
# sequentially consistent. Where the value at the pointer is not the expected one, it is stored as expected.
_CODE = bytes.fromhex(
    "53"  # push rbx
    "48 89 d3"  # mov rbx, rdx
    "48 8b 06"  # mov rax, [rsi]
    "48 8b 56 08"  # mov rdx, [rsi + 8]
    "f0 48 0f c7 0f"  # lock cmpxchg16b [rdi]
    "0f 94 c1"  # sete cl
    "74 07"  # je +7
    "48 89 06"  # mov [rsi], rax
    "48 89 56 08"  # mov [rsi + 8], rdx
    "0f b6 c1"  # movzx eax, cl
    "5b"  # pop rbx
    "c3"  # ret
)
_PAGE = 0x1000


@cache
def ensure_libatomic() -> None:
    """Load the library of this module where the operating system has no libatomic; otherwise do nothing.

    Call it before Dr.Jit is imported.

    Raises
    ------
    InputError
        Where there is no libatomic, and the machine is not an x86-64 one with Linux.
    """
    if not sys.platform.startswith("linux"):
        return
    try:
        ctypes.CDLL(NAME)
    except OSError:
        if platform.machine() != "x86_64":
            raise InputError(
                f'Dr.Jit, which renders and decodes, needs {NAME}, which this machine lacks: run "apt-get install '
                'libatomic1" (Debian, Ubuntu) or "dnf install libatomic" (Fedora)'
            ) from None
        file = os.memfd_create(NAME)
        with os.fdopen(file, "wb") as stream:
            stream.write(shared_library())
            stream.flush()
            ctypes.CDLL(f"/proc/self/fd/{file}", mode=ctypes.RTLD_GLOBAL)


def shared_library() -> bytes:
    """An ELF shared library for x86-64 with the one function, under the name and version that Dr.Jit asks for.

    Its first page holds header, tables and code, its second one the dynamic section, which the loader writes to.
    """
    names = [NAME, FUNCTION, VERSION]
    strings = b"\0" + b"".join(name.encode() + b"\0" for name in names)
    soname, function, version = (strings.index(b"\0" + name.encode() + b"\0") + 1 for name in names)

    at = 64 + 4 * 56  # after the header and four program headers
    tables: dict[str, int] = {}
    content = b""

    def place(name: str, data: bytes) -> None:
        nonlocal content
        content += bytes(-len(content) % 16)
        tables[name] = at + len(content)
        content += data

    place("code", _CODE)
    place("strings", strings)
    # The symbol that is always empty, and the function: global, in a section that is not named further.
    symbol = struct.pack("<IBBHQQ", function, 0x12, 0, 1, tables["code"], len(_CODE))
    place("symbols", bytes(24) + symbol)
    place("hash", struct.pack("<5I", 1, 2, 1, 0, 0))  # one bucket, two symbols, a chain of the second alone
    place("symbol versions", struct.pack("<2H", 0, 2))
    definitions = b""
    for flags, index, name, following in ((1, 1, soname, 28), (0, 2, version, 0)):
        text = strings[name : strings.index(b"\0", name)]
        definitions += struct.pack("<HHHHIII", 1, flags, index, 1, _hash(text), 20, following)
        definitions += struct.pack("<II", name, 0)
    place("version definitions", definitions)

    dynamic = [
        (14, soname),  # DT_SONAME
        (4, tables["hash"]),  # DT_HASH
        (5, tables["strings"]),  # DT_STRTAB
        (10, len(strings)),  # DT_STRSZ
        (6, tables["symbols"]),  # DT_SYMTAB
        (11, 24),  # DT_SYMENT
        (0x6FFFFFF0, tables["symbol versions"]),  # DT_VERSYM
        (0x6FFFFFFC, tables["version definitions"]),  # DT_VERDEF
        (0x6FFFFFFD, 2),  # DT_VERDEFNUM
        (0, 0),
    ]
    section = b"".join(struct.pack("<QQ", tag, value) for tag, value in dynamic)

    header = b"\x7fELF" + bytes([2, 1, 1]) + bytes(9)  # 64 bits, little-endian, version 1
    header += struct.pack("<HHIQQQIHHHHHH", 3, 62, 1, 0, 64, 0, 0, 64, 56, 4, 0, 0, 0)  # a shared library, x86-64
    first = at + len(content)
    program = [  # type, flags, offset, size, alignment
        (1, 5, 0, first, _PAGE),  # loaded, read and run
        (1, 6, _PAGE, len(section), _PAGE),  # loaded, read and written
        (2, 6, _PAGE, len(section), 8),  # the dynamic section
        (0x6474E551, 6, 0, 0, 16),  # a stack that is not run
    ]
    for kind, flags, offset, size, alignment in program:
        header += struct.pack("<IIQQQQQQ", kind, flags, offset, offset, offset, size, size, alignment)
    return (header + content).ljust(_PAGE, b"\0") + section


def _hash(name: bytes) -> int:
    """The ELF hash of a name, which the loader compares versions by."""
    value = 0
    for byte in name:
        value = (value << 4) + byte
        high = value & 0xF000_0000
        value = (value ^ high >> 24) & ~high & 0xFFFF_FFFF
    return value
