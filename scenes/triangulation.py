"""Triangles between the points of a grid and between concentric rings of points."""

from collections.abc import Sequence

import numpy as np


def grid_faces(rows: int, cols: int) -> np.ndarray:
    """Two triangles per cell of a (rows, cols) grid whose vertex (row, col) has the index ``row * cols + col``.

    Counter-clockwise when x increases with the column and y with the row. Shape (2 (rows - 1)(cols - 1), 3), int32.
    """
    corner = (np.arange(rows - 1)[:, None] * cols + np.arange(cols - 1)).ravel()
    lower = np.stack([corner, corner + 1, corner + cols + 1], axis=-1)
    upper = np.stack([corner, corner + cols + 1, corner + cols], axis=-1)
    return np.concatenate([lower, upper]).astype(np.int32)


def grid_points(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Points of the grid ``x`` (cols,) by ``y`` (rows,) in the order of :func:`grid_faces`, (rows * cols, 2)."""
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def ring_angles(counts: Sequence[int]) -> np.ndarray:
    """Polar angles of all points of concentric rings with ``counts[i]`` evenly spread points, (sum of counts,)."""
    return np.concatenate([2 * np.pi * np.arange(count) / count for count in counts])


def ring_faces(counts: Sequence[int]) -> np.ndarray:
    """Triangles between concentric rings, innermost first; a first ring of 1 point is the centre of a disc.

    Counter-clockwise when the angle increases with the index. Every edge of a ring gets one triangle to the
    neighbouring ring, in the order of the edges' mid-angles, so rings of any two lengths fit together. Shape (m, 3),
    int32.
    """
    starts = np.cumsum([0, *counts[:-1]])
    strips = [
        _strip(inner, outer, start, start + inner)
        for inner, outer, start in zip(counts[:-1], counts[1:], starts[:-1], strict=True)
    ]
    return np.concatenate(strips).astype(np.int32)


def _strip(inner: int, outer: int, start_inner: int, start_outer: int) -> np.ndarray:
    """Triangles between a ring of ``inner`` and one of ``outer`` points, whose indices begin at the two starts."""
    # Mid-angles of the edges as whole multiples of pi / (inner * outer), so that ties are exact.
    edge_in, edge_out = np.arange(inner), np.arange(outer)
    mid_in, mid_out = (2 * edge_in + 1) * outer, (2 * edge_out + 1) * inner

    # Apex of an edge: as many edges of the other ring on as have passed; at a tie the outer edge comes first.
    apex_in = np.searchsorted(mid_in, mid_out, side="left") % inner
    apex_out = np.searchsorted(mid_out, mid_in, side="right") % outer
    on_outer = np.stack([start_inner + apex_in, start_outer + edge_out, start_outer + (edge_out + 1) % outer], axis=-1)
    if inner == 1:
        return on_outer
    on_inner = np.stack([start_inner + edge_in, start_outer + apex_out, start_inner + (edge_in + 1) % inner], axis=-1)
    return np.concatenate([on_outer, on_inner])
