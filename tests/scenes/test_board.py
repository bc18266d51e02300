"""Claims about the printed board."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from greenough.instrument.contract import SpotBoard
from greenough.instrument.errors import InputError
from greenough.scenes.board import BoardErrors, blank_height, board, ceramic_height, print_board
from greenough.scenes.parts import Part, merge

PAPER = SpotBoard(9, 11, 0.65, 0.4, 0.175, 8.0, ((4, 5), (4, 6), (3, 5), (4, 3), (6, 5)))
PERFECT = BoardErrors(0, 0, 0, 0, 0)
DEFAULT = BoardErrors()


def made(errors=DEFAULT, seed=1, nominal=PAPER):
    return print_board(nominal, errors, np.random.default_rng(seed))


def facet_normals(part: Part) -> np.ndarray:
    """(m, 3), as long as twice the facets' areas."""
    a, b, c = np.moveaxis(part.vertices[part.faces], 1, 0)
    return np.cross(b - a, c - a)


def open_points(part: Part) -> np.ndarray:
    """Indices of the vertices at which edges of a single facet begin."""
    edges = np.concatenate([part.faces[:, [0, 1]], part.faces[:, [1, 2]], part.faces[:, [2, 0]]])
    shared = {tuple(edge) for edge in edges.tolist()}
    return np.array(sorted(a for a, b in shared if (b, a) not in shared))


def assert_within_chance(squares: np.ndarray, degrees: int, false_alarm: float = 1e-6) -> None:
    """The sum of ``squares`` of standard normal deviates is as chance would have it."""
    low, high = chi2.ppf([false_alarm / 2, 1 - false_alarm / 2], degrees)
    assert low < squares.sum() < high


def test_a_perfect_board_is_its_drawing():
    printed = made(PERFECT)
    np.testing.assert_allclose(printed.centres, PAPER.centres(), atol=1e-15)
    assert printed.bow == printed.ink_thickness == 0
    assert (printed.wedge == 0).all()


def test_each_spot_scatters_by_the_stated_amount():
    boards = [made(replace(PERFECT, print_sd_um=0.6), seed) for seed in range(50)]
    scatter = np.stack([printed.centres - PAPER.centres() for printed in boards]) / 0.6e-3
    # A shift and a rotation, three degrees of freedom of each board, are fitted away.
    assert_within_chance(scatter**2, 50 * (2 * 99 - 3))


def test_scale_bow_and_wedge_vary_by_the_stated_amounts():
    boards = [made(replace(DEFAULT, print_sd_um=0), seed) for seed in range(300)]
    nominal = PAPER.centres()
    scale = [np.sum(printed.centres * nominal) / np.sum(nominal**2) - 1 for printed in boards]
    assert_within_chance((np.array(scale) / 30e-6) ** 2, 300)
    assert_within_chance(np.array([printed.bow for printed in boards]) ** 2 / 2e-3**2, 300)
    assert_within_chance(np.array([printed.wedge for printed in boards]) ** 2 / 50e-6**2, 600)


def test_a_known_scale_error_stretches_the_print_and_adds_no_chance():
    stretched, plain = (
        made(replace(DEFAULT, print_sd_um=0, scale_error_ppm=1000)),
        made(replace(DEFAULT, print_sd_um=0)),
    )
    np.testing.assert_allclose(stretched.centres - plain.centres, 1e-3 * PAPER.centres(), atol=1e-15)
    assert (stretched.bow, *stretched.wedge) == (plain.bow, *plain.wedge)


def test_the_frame_is_best_fitted_to_the_printed_spots():
    printed, nominal = made(replace(DEFAULT, print_sd_um=20)), PAPER.centres()
    np.testing.assert_allclose(printed.centres.mean(axis=0), 0, atol=1e-15)
    turn = nominal[:, 0] * printed.centres[:, 1] - nominal[:, 1] * printed.centres[:, 0]
    np.testing.assert_allclose(turn.sum(), 0, atol=1e-12)


def test_switching_one_error_off_leaves_the_others():
    whole, without = made(), made(replace(DEFAULT, print_sd_um=0, bow_um=0))
    assert without.bow == 0
    np.testing.assert_array_equal(whole.wedge, without.wedge)
    centres = made(replace(DEFAULT, wedge_urad=0, ink_thickness_um=0)).centres
    np.testing.assert_array_equal(whole.centres, centres)


def test_the_bow_is_the_height_of_the_middle_over_the_sides_and_tilts_no_plane():
    printed = made()
    middle, side = ceramic_height(printed, np.array([[0.0, 0], [0, -4]]))
    np.testing.assert_allclose(middle - side, printed.bow)
    xy = PAPER.centres()
    plane, *_ = np.linalg.lstsq(np.column_stack([xy, np.ones(len(xy))]), ceramic_height(printed, xy))
    np.testing.assert_allclose(plane, 0, atol=1e-15)


def test_the_thickness_between_the_faces_is_the_wedge_alone():
    printed = made()
    xy = np.random.default_rng(0).uniform(-4, 4, (100, 2))
    thickness = ceramic_height(printed, xy) + blank_height(printed, xy * [-1, 1])
    np.testing.assert_allclose(thickness, xy @ printed.wedge, atol=1e-15)


@pytest.mark.parametrize("ink_um", [0.0, 1.0])
def test_spots_and_ink_tile_the_face_without_gap_or_overlap(ink_um):
    vertices, faces = merge(board(made(replace(DEFAULT, ink_thickness_um=ink_um)), "printed").parts)
    _, welded = np.unique(vertices, axis=0, return_inverse=True)
    corners = welded[faces]
    edges = Counter(map(tuple, np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]]).tolist()))
    assert max(edges.values()) == 1
    open_edges = [edge[0] for edge in edges if edge[::-1] not in edges]
    outline = np.abs(vertices[np.unique(welded, return_index=True)[1][open_edges]][:, :2]).max(axis=-1)
    np.testing.assert_allclose(outline, 4.0)
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    np.testing.assert_allclose(np.cross(b - a, c - a)[:, 2].sum() / 2, 64.0)


@pytest.mark.parametrize("ink_um", [0.0, 1.0])
def test_ink_has_walls_only_where_it_is_thick_and_no_degenerate_facets(ink_um):
    printed = made(replace(DEFAULT, ink_thickness_um=ink_um))
    _, ink = board(printed, "printed").parts
    normals = facet_normals(ink)
    assert np.linalg.norm(normals, axis=-1).min() > 1e-9
    walls = np.abs(normals[:, 2]) < 1e-12
    assert walls.any() == (ink_um > 0)
    assert (normals[~walls, 2] > 0).all()
    # A wall looks at the centre of its spot.
    middle = ink.vertices[ink.faces[walls]].mean(axis=1)[:, :2]
    inwards = printed.centres - middle[:, None]  # (walls, spots, 2)
    nearest = np.argmin(np.linalg.norm(inwards, axis=-1), axis=-1)
    assert (np.sum(inwards[np.arange(len(middle)), nearest] * normals[walls, :2], axis=-1) > 0).all()


def test_spots_are_round_and_where_they_were_printed():
    specimen = board(made(), "printed")
    spots, _ = specimen.parts
    centres = specimen.as_built["centres_mm"]
    distance = np.linalg.norm(spots.vertices[:, None, :2] - centres[:, :2], axis=-1)
    nearest = np.argmin(distance, axis=1)
    distance = distance[np.arange(len(distance)), nearest]
    radius = PAPER.diameters()[nearest] / 2
    rim = open_points(spots)
    np.testing.assert_allclose(distance[rim], radius[rim], atol=2e-9)
    assert (np.delete(distance, rim) < 0.99 * np.delete(radius, rim)).all()
    assert (distance < 1e-6).sum() == 99
    # Sides of the largest polygon come within 0.1 µm of the circle.
    points = (nearest[rim] == 4 * 11 + 5).sum()
    assert 0.2 * (1 - np.cos(np.pi / points)) < 1e-4


def test_facets_follow_the_bow_within_a_tenth_of_a_micrometre():
    printed = replace(made(), bow=6e-3, ink_thickness=0.0, wedge=np.array([1e-4, -1e-4]))
    printed_face = board(printed, "printed").parts
    for part, height in [(part, ceramic_height) for part in printed_face] + [
        (board(printed, "blank").parts[0], blank_height)
    ]:
        corners = part.vertices[part.faces]
        for weights in np.vstack([(1 - np.eye(3)) / 2, np.full((1, 3), 1 / 3)]):
            point = np.einsum("mcx,c->mx", corners, weights)
            assert np.abs(height(printed, point[:, :2]) - point[:, 2]).max() < 1e-4


def test_the_blank_face_is_whole_and_faces_up():
    (part,) = board(made(), "blank").parts
    assert part.material == "ceramic"
    normals = facet_normals(part)
    assert (normals[:, 2] > 0).all()
    np.testing.assert_allclose(normals[:, 2].sum() / 2, 64.0)


def test_spots_that_outgrow_their_cells_are_refused():
    with pytest.raises(InputError, match="half the pitch"):
        made(nominal=replace(PAPER, big_diameter_mm=0.66))


def test_a_board_too_small_for_its_spots_is_refused():
    with pytest.raises(InputError, match=r"board\.size_mm"):
        made(nominal=replace(PAPER, size_mm=7.0))


def test_a_board_without_margin_can_be_made():
    exact = replace(PAPER, rows=11, big=((5, 5),), size_mm=11 * 0.65)
    vertices, faces = merge(board(made(PERFECT, nominal=exact), "printed").parts)
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    np.testing.assert_allclose(np.cross(b - a, c - a)[:, 2].sum() / 2, 7.15**2)
