"""Dr.Jit's arrays on the CPU or a GPU, as `backend` says: every module of the pipeline imports them from here."""

from typing import TYPE_CHECKING

from greenough.instrument.backend import backend

if TYPE_CHECKING or backend() == "llvm":
    import drjit as dr  # after backend(), which finds libLLVM: Dr.Jit loads it while it is imported
    from drjit.llvm import Array2u8, Array4f, Array4f64, Bool, Complex2f, Float, Float64, UInt8, UInt32
else:
    import drjit as dr
    from drjit.cuda import Array2u8, Array4f, Array4f64, Bool, Complex2f, Float, Float64, UInt8, UInt32

__all__ = ["Array2u8", "Array4f", "Array4f64", "Bool", "Complex2f", "Float", "Float64", "UInt8", "UInt32", "dr"]
