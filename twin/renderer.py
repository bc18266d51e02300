"""Mitsuba and Dr.Jit, ready to render: every module of the twin imports the two from here.

The variant is the one that is already set in this process, else that of ``greenough.instrument.backend``: the user's
choice, else ``cuda_ad_mono`` where there is a GPU and ``llvm_ad_mono`` elsewhere. One pass over all patterns needs a
compiled kernel, and a fringe stack is monochrome, so that no other variant will do.
"""

from greenough.instrument.backend import VARIANTS, backend
from greenough.instrument.errors import InputError
from greenough.instrument.libatomic import ensure_libatomic
from greenough.instrument.llvm import ensure_llvm

ensure_libatomic()
ensure_llvm()

import drjit as dr  # noqa: E402  Dr.Jit loads both libraries while it is imported
import mitsuba as mi  # noqa: E402  imports Dr.Jit

_set_before = mi.variant()
if _set_before is None:
    mi.set_variant(f"{backend()}_ad_mono")
elif _set_before not in VARIANTS:
    raise InputError(f"Mitsuba variant {_set_before!r} cannot render fringe stacks: use one of {', '.join(VARIANTS)}")

__all__ = ["dr", "mi"]
