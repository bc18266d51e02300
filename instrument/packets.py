"""NumPy's arrays as Dr.Jit can read them: it computes on whole packets of elements."""

import numpy as np

LANES = 16
"""Elements of the widest packet of Dr.Jit's CPU backend, AVX-512's."""


def packed(values: np.ndarray) -> np.ndarray:
    """The same values as a contiguous array (n,) whose memory goes on to the end of its last packet.

    Dr.Jit takes over a NumPy array without a copy and reads its last packet whole. Where an array ends within one, and
    its memory page with it, the process would die; such an array is copied to where there is room.
    """
    flat = np.ascontiguousarray(values).ravel()
    rest = -len(flat) % LANES
    if not rest:
        return flat
    room = np.empty(len(flat) + rest, flat.dtype)
    room[: len(flat)] = flat
    return room[: len(flat)]
