"""Numbers that kernels read from memory, so that instruments that differ in nothing else share their kernels.

Dr.Jit writes a plain number into the code of a kernel, which is then compiled for that number alone.
"""

from typing import Any

from .renderer import dr


def in_memory(kind: Any, value: Any) -> Any:
    """``value`` as an evaluated array of ``kind`` with one element; arrays stay what they are.

    So do 0 and 1, the numbers of what is as designed: they cost nothing in the code.
    """
    return dr.opaque(kind, value) if isinstance(value, float) and value not in (0.0, 1.0) else value
