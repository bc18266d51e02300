"""Letters and digits as strokes, and distances to them.

A glyph is one unit high and stands on y = 0. It consists of strokes; a stroke is a chain of straight lines and
circular arcs that continue each other without a corner, so the distance to it has no crease near it. Corners are where
strokes meet.
"""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Line:
    """From ``start`` to ``end``."""

    start: tuple[float, float]
    end: tuple[float, float]


@dataclass(frozen=True)
class Arc:
    """Around ``centre``, from the polar angle ``start_deg`` counter-clockwise over ``sweep_deg`` (> 0)."""

    centre: tuple[float, float]
    radius: float
    start_deg: float
    sweep_deg: float


Piece = Line | Arc
Stroke = tuple[Piece, ...]

WIDTH = 0.64  # of a glyph, in heights

GLYPHS: dict[str, tuple[Stroke, ...]] = {
    "E": (
        (Line((0, 0), (0, 1)),),
        (Line((0, 1), (0.6, 1)),),
        (Line((0, 0.5), (0.5, 0.5)),),
        (Line((0, 0), (0.6, 0)),),
    ),
    "G": (
        (
            Arc((0.32, 0.68), 0.32, 45, 135),
            Line((0, 0.68), (0, 0.32)),
            Arc((0.32, 0.32), 0.32, 180, 180),
            Line((0.64, 0.32), (0.64, 0.43)),
        ),
        (Line((0.64, 0.43), (0.36, 0.43)),),
    ),
    "N": (
        (Line((0, 0), (0, 1)),),
        (Line((0, 1), (0.64, 0)),),
        (Line((0.64, 0), (0.64, 1)),),
    ),
    "R": (
        (Line((0, 0), (0, 1)),),
        (Line((0, 1), (0.34, 1)), Arc((0.34, 0.73), 0.27, -90, 180), Line((0.34, 0.46), (0, 0.46))),
        (Line((0.32, 0.46), (0.62, 0)),),
    ),
    "1": (
        (Line((0.36, 0), (0.36, 1)),),
        (Line((0.36, 1), (0.1, 0.8)),),
        (Line((0.1, 0), (0.62, 0)),),
    ),
    # The two bowls touch.
    "8": (
        (Arc((0.32, 0.76), 0.24, 0, 360),),
        (Arc((0.32, 0.26), 0.26, 0, 360),),
    ),
    "9": (
        (Arc((0.32, 0.7), 0.3, 0, 360),),
        (Line((0.62, 0.7), (0.62, 0.3)), Arc((0.32, 0.3), 0.3, -150, 150)),
    ),
    # The diagonal is the tangent of the bowl from (0, 0).
    "2": (
        (Arc((0.32, 0.72), 0.28, -44.7655, 204.7655), Line((0, 0), (0.518803, 0.522826))),
        (Line((0, 0), (0.62, 0)),),
    ),
}


def placed(stroke: Stroke, height: float, x: float, y: float) -> Stroke:
    """``stroke`` enlarged by ``height`` and moved so that its glyph's lower left corner lies at (``x``, ``y``)."""

    def point(p: tuple[float, float]) -> tuple[float, float]:
        return (p[0] * height + x, p[1] * height + y)

    return tuple(
        Line(point(piece.start), point(piece.end))
        if isinstance(piece, Line)
        else Arc(point(piece.centre), piece.radius * height, piece.start_deg, piece.sweep_deg)
        for piece in stroke
    )


def offset_from(stroke: Stroke, xy: np.ndarray) -> np.ndarray:
    """Vectors (..., 2) from the nearest point of ``stroke`` to ``xy`` (..., 2)."""
    offsets = np.stack([xy - _nearest(piece, xy) for piece in stroke])
    nearest = np.argmin(np.sum(offsets**2, axis=-1), axis=0)
    return np.take_along_axis(offsets, nearest[None, ..., None], axis=0)[0]


def bounds(stroke: Stroke) -> np.ndarray:
    """Box around ``stroke``: ((x, y) minimum, (x, y) maximum)."""
    points = []
    for piece in stroke:
        if isinstance(piece, Line):
            points += [piece.start, piece.end]
        else:
            angle = np.deg2rad(piece.start_deg + np.linspace(0, 1, 181) * piece.sweep_deg)
            points += (np.array(piece.centre) + piece.radius * np.stack([np.cos(angle), np.sin(angle)], -1)).tolist()
    return np.array([np.min(points, axis=0), np.max(points, axis=0)])


def _nearest(piece: Piece, xy: np.ndarray) -> np.ndarray:
    """Nearest points (..., 2) of ``piece`` to ``xy`` (..., 2)."""
    if isinstance(piece, Line):
        start, along = np.array(piece.start), np.subtract(piece.end, piece.start)
        share = np.clip((xy - start) @ along / (along @ along), 0, 1)
        return start + share[..., None] * along
    centre = np.array(piece.centre)
    start, sweep = np.deg2rad(piece.start_deg), np.deg2rad(piece.sweep_deg)
    angle = np.arctan2(xy[..., 1] - centre[1], xy[..., 0] - centre[0])
    # Relative to the arc's middle, so that what lies beyond an end goes to the nearer end.
    beyond = np.mod(angle - start - sweep / 2 + np.pi, 2 * np.pi) - np.pi
    angle = start + sweep / 2 + np.clip(beyond, -sweep / 2, sweep / 2)
    return centre + piece.radius * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
