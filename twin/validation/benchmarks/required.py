"""The rows that the table must have, by section: whatever measures them, none may get lost."""

from collections.abc import Mapping
from typing import Literal

Section = Literal["startup", "capturing", "scaling", "study"]
"""One module of this package each, in the order in which they are run."""

STARTUP = (
    "greenough --help",
    "python -c pass",
    *(
        name
        for step in ("decode", "capture")
        for name in (
            f"first {step}, no kernel on disk",
            f"of which compiling, {step}",
            f"first {step}, kernels on disk",
            f"second {step} of a process",
            f"kernels of a first {step} compiled anew in spite of the disk",
        )
    ),
)

CAPTURING = (
    "render a plane, all patterns",
    "render a plane, one pattern",
    "capture the board, all patterns",
    "find the board's spots",
)

STUDY = ("study of 4 instruments, two workers of one thread",)

_SERIES = (
    ("decode", "pixels", ("x1", "x4", "x16")),
    ("frames to points", "pixels", ("x1", "x4", "x16")),
    ("fit", "pixels", ("x1", "x4", "x16")),
    ("render", "pixels", ("x1", "x4", "x16")),
    ("decode", "patterns", (9, 24, 48)),
    ("render", "patterns", (9, 24, 48)),
    ("fit", "planes", (10, 30, 100)),
    ("load a mesh", "triangles", (10_000, 100_000, 1_000_000, 10_000_000)),
    ("render", "triangles", (10_000, 100_000, 1_000_000, 10_000_000)),
    ("render", "samples", (16, 64, 256)),
)

SCALING = tuple(
    name
    for step, of, sizes in _SERIES
    for name in (
        *(f"{step}, {size} {of}" for size in sizes),
        *(f"{step}, {size} {of}, peak memory" for size in sizes),
        f"{step}, exponent of time in {of}",
    )
)

REQUIRED: Mapping[Section, tuple[str, ...]] = {
    "startup": STARTUP,
    "capturing": CAPTURING,
    "scaling": SCALING,
    "study": STUDY,
}
