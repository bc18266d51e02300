"""Claims about letters as strokes."""

from itertools import pairwise

import numpy as np
import pytest

from greenough.scenes.glyphs import GLYPHS, WIDTH, Line, bounds, offset_from, placed

STROKES = [pytest.param(stroke, id=f"{letter}-{k}") for letter, all_ in GLYPHS.items() for k, stroke in enumerate(all_)]


def points_on(piece, count=4001):
    """Densely spread points of a piece, from one end to the other, (count, 2)."""
    share = np.linspace(0, 1, count)[:, None]
    if isinstance(piece, Line):
        return np.array(piece.start) + share * np.subtract(piece.end, piece.start)
    angle = np.deg2rad(piece.start_deg + share * piece.sweep_deg)
    return np.array(piece.centre) + piece.radius * np.concatenate([np.cos(angle), np.sin(angle)], axis=1)


@pytest.mark.parametrize("stroke", STROKES)
def test_the_offset_leads_to_the_nearest_point_of_the_stroke(stroke):
    xy = np.random.default_rng(0).uniform(-0.5, 1.5, (200, 2))
    offset = offset_from(stroke, xy)
    dense = np.concatenate([points_on(piece) for piece in stroke])
    brute = np.linalg.norm(xy[:, None] - dense, axis=-1).min(axis=-1)
    # Points spread by < 5e-4 miss the foot by half of that at most.
    np.testing.assert_allclose(np.linalg.norm(offset, axis=-1), brute, atol=2.6e-4)
    foot = np.linalg.norm((xy - offset)[:, None] - dense, axis=-1).min(axis=-1)
    assert foot.max() < 2.6e-4


@pytest.mark.parametrize("stroke", STROKES)
def test_pieces_continue_each_other_without_a_corner(stroke):
    for one, other in pairwise(stroke):
        ends = [(p[i], p[j] - p[i]) for p in (points_on(one), points_on(other)) for i, j in ((0, 1), (-1, -2))]
        gap, turn = min(
            (np.linalg.norm(p - q), 1 + (u @ v) / np.linalg.norm(u) / np.linalg.norm(v))
            for p, u in ends[:2]
            for q, v in ends[2:]
        )
        assert gap < 1e-5
        assert turn < 1e-6  # both lead away from the joint, in opposite directions


@pytest.mark.parametrize("stroke", STROKES)
def test_glyphs_keep_to_their_cell(stroke):
    low, high = bounds(stroke)
    assert (low >= -1e-9).all()
    assert (high <= [WIDTH + 1e-9, 1 + 1e-9]).all()


@pytest.mark.parametrize("stroke", STROKES)
def test_a_placed_stroke_is_enlarged_and_moved(stroke):
    moved = np.concatenate([points_on(piece) for piece in placed(stroke, 1.5, -2.0, 0.5)])
    original = np.concatenate([points_on(piece) for piece in stroke])
    np.testing.assert_allclose(moved, original * 1.5 + [-2.0, 0.5], atol=1e-12)
