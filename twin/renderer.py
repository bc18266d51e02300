"""Chooses the Mitsuba variant of this process and registers the plugins."""

import importlib
import os

from greenough.instrument.errors import InputError
from greenough.instrument.llvm import ensure_llvm

VARIANTS = ("llvm_ad_mono", "cuda_ad_mono")


def start() -> None:
    """Make Mitsuba ready: the variant is the one already set, else $GREENOUGH_VARIANT, else ``llvm_ad_mono``.

    Raises InputError for a variant other than those two: one pass over all patterns needs a compiled kernel, and a
    fringe stack is monochrome.
    """
    ensure_llvm()
    mi = importlib.import_module("mitsuba")
    wanted = mi.variant() or os.environ.get("GREENOUGH_VARIANT", VARIANTS[0])
    if wanted not in VARIANTS:
        raise InputError(f"Mitsuba variant {wanted!r} cannot render fringe stacks: use one of {', '.join(VARIANTS)}.")
    if mi.variant() is None:
        mi.set_variant(wanted)
    importlib.import_module("greenough.twin.plugins")
