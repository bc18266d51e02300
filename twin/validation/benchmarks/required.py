"""The rows that the table must have, by section: whatever measures them, none may get lost."""

from collections.abc import Mapping
from typing import Literal

Section = Literal[
    "startup", "decoding", "calibrating", "rendering", "capturing", "scaling", "study", "calibration", "demo"
]
"""In the order in which they are measured."""

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
            f"kernels of a {step} compiled for another instrument",
        )
    ),
)

_DECODERS = ("NumPy", "fringes, fast", "fringes, precise")

DECODING = (
    "copy the frames",
    "decode",
    "frames to points",
    *(f"decode, against {peer}" for peer in _DECODERS),
    *(f"wrong fringe orders at a noise of {noise} DN, against {peer}" for noise in (1, 3, 5, 8) for peer in _DECODERS),
)

CALIBRATING = (
    "fit every pixel",
    "fit every pixel, against SciPy",
    "fit every pixel, peak memory",
    "calibrate the camera",
    "bundle adjustment",
    "calibrate by the bundle, from phases",
)

_OTHER = "Mitsuba's own plugins"

RENDERING = (
    f"mean light, ours against {_OTHER}",
    f"mean phase, ours against {_OTHER}",
    "BGA, all patterns, 16 paths, 160 x 120 px",
    "BGA, all patterns, as the rig renders it, 160 x 120 px",
    "sampling error of the BGA's densest fringes",
    *(f"sampling error of {_OTHER}, {paths} paths" for paths in (16, 64, 256)),
    f"paths of {_OTHER} for the same error",
    *(
        f"render {part} in coarser pixels, all patterns, {lenses}"
        for part in ("the blank plane", "the board", "the coin", "the BGA")
        for lenses in ("pinholes", "thin lenses", "glass")
    ),
    "place and capture a posture, all patterns",
    "move and capture a plane, all patterns",
    "captures of a whole calibration",
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

CALIBRATION = ("whole calibration", "whole calibration, capturing", "whole calibration, after capturing")

REQUIRED: Mapping[Section, tuple[str, ...]] = {
    "startup": STARTUP,
    "decoding": DECODING,
    "calibrating": CALIBRATING,
    "rendering": RENDERING,
    "capturing": CAPTURING,
    "scaling": SCALING,
    "study": STUDY,
    "calibration": CALIBRATION,
    "demo": ("demo",),
}
