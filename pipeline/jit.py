"""Dr.Jit's arrays on the CPU: every module of the pipeline imports them from here, once libLLVM is found."""

from greenough.instrument.llvm import ensure_llvm

ensure_llvm()

import drjit as dr  # noqa: E402  Dr.Jit loads libLLVM while it is imported: ensure_llvm must come first
from drjit.llvm import Bool, Complex2f, Float, Float64, UInt8, UInt32  # noqa: E402  part of Dr.Jit: see there

__all__ = ["Bool", "Complex2f", "Float", "Float64", "UInt8", "UInt32", "dr"]
