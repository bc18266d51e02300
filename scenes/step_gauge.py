"""A step gauge: a flat plate with three ridges and three grooves of certified heights.

Ridges stand in the upper lane (+y), grooves lie in the lower one, all along y. Every step is of the kind that ISO
5436-1 calls type A1 and has room for its window of three times its width W: the middle third of the step, and plateaus
from W / 3 to W away from its walls. The plateaus, at z = 0, go on for another half width before the next step. The
walls are vertical; as deep as the deepest groove is, their shadows stay shorter than W / 3.
"""

from collections.abc import Sequence

import numpy as np

from .parts import Part, Specimen, merge

WIDTH_MM = 0.8
"""Of ridges and grooves."""

PLATEAU_MM = 1.2
"""Of the plateaus between and beside them."""

RIDGES_MM = (0.3, 0.7, 1.1)
GROOVES_MM = (-0.5, -0.9, -1.3)

LANES_MM = ((0.2, 2.8), (-2.8, -0.2))
"""From and to which y the ridges and the grooves reach."""

_SD_MM = 1e-3
_HALF_HEIGHT_MM = 3.1  # of the plate along y


def step_gauge(seed: int) -> Specimen:
    """A gauge whose steps are each 1 um (sd) off their nominal heights.

    ``as_built``: ``step_heights_mm`` (6,), of ridges above and grooves below the plateaus; ``step_boxes_mm`` (6, 2, 2),
    the least and the largest x and y of each step's floor, ((x, x), (y, y)).
    """
    nominal = np.array([*RIDGES_MM, *GROOVES_MM])
    heights = nominal + _SD_MM * np.random.default_rng(seed).standard_normal(len(nominal))
    apart = WIDTH_MM + PLATEAU_MM
    boxes = np.array(
        [((middle - WIDTH_MM / 2, middle + WIDTH_MM / 2), lane) for lane in LANES_MM for middle in (-apart, 0.0, apart)]
    )
    half_width = 1.5 * WIDTH_MM + 2 * PLATEAU_MM
    x = np.array([-half_width, *np.unique(boxes[:, 0]), half_width])
    y = np.array([-_HALF_HEIGHT_MM, *np.unique(boxes[:, 1]), _HALF_HEIGHT_MM])
    level = np.zeros((len(y) - 1, len(x) - 1))  # of each cell
    for height, (along, across) in zip(heights, boxes, strict=True):
        level[np.searchsorted(y, across[0]), np.searchsorted(x, along[0])] = height
    vertices, faces = merge([*_floors(x, y, level), *_walls(x, y, level)])
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    normals = np.cross(b - a, c - a)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    # Corners are not shared between facets: each has the normal of its own.
    part = Part(
        vertices[faces].reshape(-1, 3),
        np.arange(3 * len(faces), dtype=np.int32).reshape(-1, 3),
        np.repeat(normals, 3, axis=0),
        "matte",
    )
    return Specimen(
        "step-gauge",
        (part,),
        {"width_mm": WIDTH_MM, "plateau_mm": PLATEAU_MM}
        | {f"step_{index}_mm": float(height) for index, height in enumerate(nominal)},
        {"step_heights_mm": heights, "step_boxes_mm": boxes},
    )


def _floors(x: np.ndarray, y: np.ndarray, level: np.ndarray) -> list[Part]:
    """A rectangle at its ``level`` (rows, cols) for every cell of the grid."""
    return [
        _quad([(x[j], y[i], z), (x[j + 1], y[i], z), (x[j + 1], y[i + 1], z), (x[j], y[i + 1], z)])
        for (i, j), z in np.ndenumerate(level)
    ]


def _walls(x: np.ndarray, y: np.ndarray, level: np.ndarray) -> list[Part]:
    """Vertical rectangles wherever neighbouring cells differ in ``level``; each faces the lower one."""
    walls = []
    for (i, j), right in np.ndenumerate(level[:, 1:]):
        left = level[i, j]
        if left != right:
            at = x[j + 1]
            walls.append(_quad([(at, y[i + 1], left), (at, y[i], left), (at, y[i], right), (at, y[i + 1], right)]))
    for (i, j), upper in np.ndenumerate(level[1:]):
        lower = level[i, j]
        if lower != upper:
            at = y[i + 1]
            walls.append(_quad([(x[j], at, lower), (x[j + 1], at, lower), (x[j + 1], at, upper), (x[j], at, upper)]))
    return walls


def _quad(corners: Sequence[Sequence[float | np.ndarray]]) -> Part:
    return Part(np.array(corners, float), np.array([[0, 1, 2], [0, 2, 3]], np.int32), None, "matte")
