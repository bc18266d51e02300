"""Where Dr.Jit computes: on the CPU or on an NVIDIA GPU, for the renderer and for the pipeline alike."""

import os
from typing import Literal

from .errors import InputError
from .libatomic import ensure_libatomic
from .llvm import ensure_llvm

VARIABLE = "GREENOUGH_VARIANT"

Backend = Literal["cuda", "llvm"]

VARIANTS: dict[str, Backend] = {"cuda_ad_mono": "cuda", "llvm_ad_mono": "llvm"}
"""The Mitsuba variants that can render fringe stacks, by which the user chooses, and the backend of each."""


def backend() -> Backend:
    """The backend of ``$GREENOUGH_VARIANT``, else CUDA where Dr.Jit finds a GPU, else LLVM.

    Imports Dr.Jit where it has to look for a GPU: call it where Dr.Jit is about to be used.

    Raises
    ------
    InputError
        If the variable names no variant of ``VARIANTS``.
    """
    ensure_libatomic()
    ensure_llvm()
    wanted = os.environ.get(VARIABLE)
    if not wanted:
        import drjit as dr

        return "cuda" if dr.has_backend(dr.JitBackend.CUDA) else "llvm"
    if wanted not in VARIANTS:
        raise InputError(
            f"{VARIABLE}: Mitsuba variant {wanted!r} cannot render fringe stacks: use one of {', '.join(VARIANTS)}, or "
            "leave the variable unset"
        )
    return VARIANTS[wanted]
