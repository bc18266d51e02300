"""Finds libLLVM for Dr.Jit's CPU backend, so that pip alone sets everything up."""

import os
import sys
from pathlib import Path

VARIABLE = "DRJIT_LIBLLVM_PATH"


def ensure_llvm() -> None:
    """Point Dr.Jit at the libLLVM that pip installed into this environment, if there is one.

    A path already set by the user is left alone, and where no wheel exists Dr.Jit looks for the system's LLVM by
    itself. Call it before Dr.Jit is imported, which is when it chooses its LLVM; calling it again does nothing.
    """
    if VARIABLE in os.environ:
        return
    libraries = sorted(Path(sys.prefix, "lib").glob("libLLVM.so.*"))
    if libraries:
        os.environ[VARIABLE] = str(libraries[-1])
