"""Claims about the triangulations that specimens share."""

from collections import Counter

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from greenough.scenes.triangulation import grid_faces, grid_points, ring_angles, ring_faces


def doubled_areas(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Twice the signed area of each triangle of (n, 2) points."""
    a, b, c = (points[faces[:, corner]] for corner in range(3))
    return (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]


def directed_edges(faces: np.ndarray) -> Counter:
    return Counter(map(tuple, np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).tolist()))


@given(st.integers(2, 9), st.integers(2, 9))
def test_a_grid_is_tiled_once_and_counter_clockwise(rows, cols):
    x, y = np.linspace(0, 2, cols) ** 2, np.linspace(-1, 2, rows)
    areas = doubled_areas(grid_points(x, y), grid_faces(rows, cols))
    assert len(areas) == 2 * (rows - 1) * (cols - 1)
    assert areas.min() > 0
    np.testing.assert_allclose(areas.sum() / 2, 4 * 3)


@given(st.booleans(), st.lists(st.integers(3, 40), min_size=2, max_size=6))
def test_rings_of_any_lengths_are_joined_without_gap_or_overlap(with_centre, lengths):
    counts = [1, *lengths] if with_centre else lengths
    faces = ring_faces(counts)
    edges = directed_edges(faces)
    assert max(edges.values()) == 1
    borders = {edge for edge in edges if edge[::-1] not in edges}
    # What remains open is the outermost ring, counter-clockwise, and the innermost, clockwise, if it is no point.
    start = sum(counts[:-1])
    expected = {(start + k, start + (k + 1) % counts[-1]) for k in range(counts[-1])}
    if not with_centre:
        expected |= {((k + 1) % counts[0], k) for k in range(counts[0])}
    assert borders == expected


@given(st.lists(st.integers(20, 40), min_size=1, max_size=6))
def test_rings_that_grow_outwards_give_upright_triangles(lengths):
    counts = [1, *lengths]
    angle = ring_angles(counts)
    radius = np.repeat(np.arange(len(counts)), counts)
    points = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=-1)
    areas = doubled_areas(points, ring_faces(counts))
    assert areas.min() > 0
    outermost = counts[-1] / 2 * np.sin(2 * np.pi / counts[-1]) * (len(counts) - 1) ** 2
    np.testing.assert_allclose(areas.sum() / 2, outermost)
