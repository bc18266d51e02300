"""Mitsuba and Dr.Jit, ready to render: every module of the twin imports the two from here.

The variant is the one that is already set, else ``$GREENOUGH_VARIANT``, else ``llvm_ad_mono``. One pass over all
patterns needs a compiled kernel, and a fringe stack is monochrome, so only ``llvm_ad_mono`` and ``cuda_ad_mono`` will
do.
"""

import os

from greenough.instrument.errors import InputError
from greenough.instrument.llvm import ensure_llvm

ensure_llvm()

import drjit as dr  # noqa: E402  Dr.Jit loads libLLVM while it is imported: ensure_llvm must come first
import mitsuba as mi  # noqa: E402  imports Dr.Jit

VARIANTS = ("llvm_ad_mono", "cuda_ad_mono")

_wanted = mi.variant() or os.environ.get("GREENOUGH_VARIANT", VARIANTS[0])
if _wanted not in VARIANTS:
    raise InputError(f"Mitsuba variant {_wanted!r} cannot render fringe stacks: use one of {', '.join(VARIANTS)}.")
if mi.variant() is None:
    mi.set_variant(_wanted)

__all__ = ["dr", "mi"]
