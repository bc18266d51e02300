"""A piece of a coin: letters, digits and a rim struck into metal, tilted.

The relief is a height field. Every stroke has a flat top and a bevel that falls as a raised cosine of the distance to
it, so all edges are rounded; where strokes meet, they are united smoothly. z = 0 is the middle of the tilted piece's
heights.
"""

from collections.abc import Sequence

import numpy as np
from scipy.optimize import root_scalar

from .glyphs import GLYPHS, WIDTH, Arc, Stroke, bounds, offset_from, placed
from .parts import Part, Specimen
from .triangulation import grid_faces, grid_points

SIZE_MM = (7.4, 6.2)
RELIEF_MM = 0.05
SPAN_MM = 0.3
LETTER_HEIGHT_MM = 1.25
BEVEL_MM = 0.205  # width
STEP_MM = 0.007  # distance of neighbouring vertices

_TEXT = (("GREEN", 0.85), ("1892", -1.2))  # lines with the height of their feet
_ADVANCE_MM = 1.4  # from one letter to the next
_CORE_MM = 0.06  # half the width of a letter's flat top
_RIM_CORE_MM = 0.2
_BLEND_MM = 0.13  # strokes whose distances differ by less are blended
_FAR_MM = 1e3  # where no stroke has been yet
_RIM = Arc((0.0, 8.85), 11.5, -130, 80)
_TILT_AZIMUTH = np.deg2rad(30.0)  # direction that rises


def coin() -> Specimen:
    """The coin's piece, 7.4 x 6.2 mm, with its heights spanning 0.3 mm."""
    x, y = (np.linspace(-0.5, 0.5, round(size / STEP_MM) + 1) * size for size in SIZE_MM)
    height, gradient = relief(x, y)
    points = np.column_stack([grid_points(x, y), height.ravel()])
    normals = np.column_stack([-gradient.reshape(-1, 2), np.ones(len(points))])
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)

    def excess(angle: float) -> float:
        return np.ptp(points @ _tilt(angle)[2]) - SPAN_MM

    tilt = root_scalar(excess, bracket=(0.0, 0.2)).root
    rotation = _tilt(tilt)
    vertices = points @ rotation.T
    vertices[:, 2] -= (vertices[:, 2].min() + vertices[:, 2].max()) / 2
    part = Part(vertices, grid_faces(len(y), len(x)), normals @ rotation.T, "metal")
    nominal = {
        "width_mm": SIZE_MM[0],
        "height_mm": SIZE_MM[1],
        "relief_mm": RELIEF_MM,
        "bevel_mm": BEVEL_MM,
        "letter_height_mm": LETTER_HEIGHT_MM,
        "tilt_deg": float(np.rad2deg(tilt)),
        "span_mm": SPAN_MM,
    }
    return Specimen("coin", (part,), nominal)


def relief(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Relief over the coin's field on the grid ``x`` (cols,) by ``y`` (rows,), before it is tilted.

    Returns
    -------
    height : (rows, cols) float64
        In mm.
    gradient : (rows, cols, 2) float64
        (d/dx, d/dy).
    """
    distance = np.full((len(y), len(x)), _FAR_MM)
    direction = np.zeros((len(y), len(x), 2))
    for stroke, core in _strokes():
        # Further out the stroke can no longer lift anything, even blended with two others.
        low, high = bounds(stroke) + (core + BEVEL_MM + 2 * _BLEND_MM) * np.array([[-1], [1]])
        window = (
            slice(*np.searchsorted(y, [low[1], high[1]])),
            slice(*np.searchsorted(x, [low[0], high[0]])),
        )
        offset = offset_from(stroke, np.stack(np.meshgrid(x[window[1]], y[window[0]]), axis=-1))
        length = np.linalg.norm(offset, axis=-1)
        unit = offset / np.maximum(length, np.finfo(float).tiny)[..., None]
        distance[window], direction[window] = _blended(distance[window], direction[window], length - core, unit)

    phase = np.pi * np.clip(distance / BEVEL_MM, 0, 1)
    by_distance = -RELIEF_MM * np.pi / (2 * BEVEL_MM) * np.sin(phase)
    return RELIEF_MM * (1 + np.cos(phase)) / 2, by_distance[..., None] * direction


def _blended(
    first: np.ndarray, first_gradient: np.ndarray, second: np.ndarray, second_gradient: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The smaller of two distances (...), with gradients (..., 2), rounded where they differ by less than the blend.

    min(a, b) - k m² / 4 with m = max(0, 1 - |a - b| / k): continuous with its gradient, which is a weighted mean of
    both, so no bevel gets steeper.
    """
    mix = np.maximum(0.0, 1 - np.abs(first - second) / _BLEND_MM)
    weight = np.where(first < second, mix / 2, 1 - mix / 2)[..., None]  # of the second
    gradient = (1 - weight) * first_gradient + weight * second_gradient
    return np.minimum(first, second) - _BLEND_MM / 4 * mix**2, gradient


def _strokes() -> Sequence[tuple[Stroke, float]]:
    """All strokes in mm, each with half the width of its flat top."""
    strokes: list[tuple[Stroke, float]] = [((_RIM,), _RIM_CORE_MM)]
    for text, foot in _TEXT:
        start = -((len(text) - 1) * _ADVANCE_MM + WIDTH * LETTER_HEIGHT_MM) / 2
        for index, letter in enumerate(text):
            for stroke in GLYPHS[letter]:
                strokes.append((placed(stroke, LETTER_HEIGHT_MM, start + index * _ADVANCE_MM, foot), _CORE_MM))
    return strokes


def _tilt(angle: float) -> np.ndarray:
    """Rotation (3, 3) by ``angle`` that lifts the side in the direction of the tilt's azimuth."""
    c, s = np.cos(_TILT_AZIMUTH), np.sin(_TILT_AZIMUTH)
    axes = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
    ca, sa = np.cos(angle), np.sin(angle)
    return axes.T @ np.array([[ca, 0, -sa], [0, 1, 0], [sa, 0, ca]]) @ axes
