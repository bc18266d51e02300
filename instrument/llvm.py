"""Finds libLLVM for Dr.Jit's CPU backend, so that pip alone sets everything up."""

import os
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

VARIABLE = "DRJIT_LIBLLVM_PATH"
PACKAGE = "karellen-llvm-core"


def ensure_llvm() -> None:
    """Point Dr.Jit at the libLLVM that pip installed, if there is one.

    A path already set by the user is left alone, and where no wheel exists Dr.Jit looks for the system's LLVM by
    itself; an old one, 15 for example, ends the process while it compiles. Call this function before Dr.Jit is
    imported, which is when it chooses its LLVM; calling it again does nothing.
    """
    if VARIABLE in os.environ:
        return
    try:
        files = distribution(PACKAGE).files or []
    except PackageNotFoundError:
        return
    libraries = [Path(str(file.locate())) for file in files if file.name.startswith("libLLVM.so.")]
    for library in libraries:
        if library.exists():
            os.environ[VARIABLE] = str(library.resolve())
