"""NumPy's arrays as Dr.Jit can read them: it computes on whole packets of elements."""

import numpy as np

LANES = 16
"""Elements of the widest packet of Dr.Jit's CPU backend, AVX-512's."""

ALIGNED_BYTES = 64
"""Arrays that begin at a multiple of it are aligned for that packet of float32."""


def packed(values: np.ndarray, aligned: bool = False) -> np.ndarray:
    """The same values as a contiguous array (n,) whose memory goes on to the end of its last packet.

    Dr.Jit takes over a NumPy array without a copy and reads its last packet whole. Where an array ends within one, and
    its memory page with it, the process would die; such an array is copied to where there is room.

    With ``aligned`` an array that begins anywhere else than at a multiple of ``ALIGNED_BYTES`` is copied, too. Dr.Jit
    compiles a kernel for arrays that do or that do not, one by one: where several were made by chance, it would hardly
    ever find the kernel for them among those that it has compiled before.
    """
    flat = np.ascontiguousarray(values).ravel()
    rest = -len(flat) % LANES
    if not rest and (not aligned or flat.ctypes.data % ALIGNED_BYTES == 0):
        return flat
    size = len(flat) + rest
    raw = np.empty(size * flat.itemsize + ALIGNED_BYTES, np.uint8)
    start = -raw.ctypes.data % ALIGNED_BYTES
    room = raw[start : start + size * flat.itemsize].view(flat.dtype)
    room[: len(flat)] = flat
    return room[: len(flat)]
