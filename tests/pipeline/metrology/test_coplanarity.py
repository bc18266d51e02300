"""Coplanarity of constructed apexes, by either plane."""

from itertools import combinations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from greenough.instrument.errors import InputError
from greenough.pipeline.metrology.coplanarity import coplanarity, regression_plane, seating_planes

CENTRE = np.zeros(2)


def square(*heights: float) -> np.ndarray:
    """Four apexes on the corners of a square of 2, then one at (0.3, 0.2)."""
    xy = [(-1, -1), (1, -1), (1, 1), (-1, 1), (0.3, 0.2)][: len(heights)]
    return np.column_stack([np.array(xy, float), heights])


def test_the_package_stands_on_three_apexes_and_above_all():
    """The middle one is the highest; of the triangles that it spans one holds the centre."""
    apexes = square(0.0, 0.0, 0.0, -1.0, 0.5)
    (plane,) = seating_planes(apexes, CENTRE)
    above = plane[0] + apexes[:, :2] @ plane[1:] - apexes[:, 2]
    np.testing.assert_array_equal(above < 1e-12, [True, False, False, True, True])


def test_flat_but_one_low_ball():
    """Eight apexes of height 0 and one, off the corner, 10 um low: the plane is z = 0 and the worst is the low one."""
    x, y = np.meshgrid([-1.0, 0.0, 1.0], [-1.0, 0.0, 1.0])
    z = np.zeros(9)
    z[5] = -0.010
    # Heights alike to rounding would leave the hull's triangles to chance, all in the same plane.
    apexes = np.column_stack([x.ravel(), y.ravel(), z - 1e-9 * (x.ravel() ** 2 + y.ravel() ** 2)])
    assert coplanarity(apexes, seating_planes(apexes, CENTRE)) == pytest.approx(0.010, abs=1e-7)


def test_distances_are_perpendicular_to_the_plane():
    assert coplanarity(np.array([[0.0, 0.0, -1.0]]), np.array([0.0, 1.0, 0.0])) == pytest.approx(np.sqrt(0.5))


@pytest.mark.parametrize("seed", range(6))
def test_the_seating_plane_is_the_lowest_that_keeps_above_all_apexes(seed):
    """Brute force: of all planes through three apexes and above the others, the one that is lowest at the centre."""
    rng = np.random.default_rng(seed)
    apexes = np.column_stack([rng.uniform(-1, 1, (12, 2)), 0.05 * rng.standard_normal(12)])
    lowest, best = np.inf, None
    for i in range(12):
        for j in range(i):
            for k in range(j):
                three = apexes[[i, j, k]]
                plane = np.linalg.solve(np.column_stack([np.ones(3), three[:, :2]]), three[:, 2])
                below = plane[0] + apexes[:, :2] @ plane[1:] - apexes[:, 2]
                if below.min() > -1e-12 and plane[0] < lowest:
                    lowest, best = plane[0], plane
    (plane,) = seating_planes(apexes, CENTRE)
    np.testing.assert_allclose(plane, best, atol=1e-9)


def test_a_package_that_rocks_is_judged_by_the_worse_of_both_planes():
    """Two opposite corners high: their line passes under the centre, and either of the others may touch as well."""
    apexes = square(0.0, -0.02, 0.0, -0.04)
    planes = seating_planes(apexes, CENTRE)
    assert len(planes) == 2
    # Either plane rises over the other diagonal by as much as it falls to its own corner: 0.06 at the free one.
    slopes = [np.sqrt(1 + 2 * drop**2) for drop in (0.01, 0.02)]
    assert sorted(coplanarity(apexes, plane) for plane in planes) == pytest.approx([0.06 / s for s in slopes[::-1]])
    assert coplanarity(apexes, planes) == pytest.approx(0.06 / slopes[0])


def test_the_regression_plane_touches_the_highest_apex():
    """Four corners at 0, one at (0.3, 0.2) 0.1 high: worked out by hand from the normal equations."""
    apexes = square(0.0, 0.0, 0.0, 0.0, 0.1)
    design = np.column_stack([np.ones(5), apexes[:, :2]])
    _, a, b = np.linalg.solve(design.T @ design, design.T @ apexes[:, 2])
    plane = regression_plane(apexes)
    np.testing.assert_allclose(plane[1:], [a, b], atol=1e-12)
    assert plane[0] + 0.3 * a + 0.2 * b == pytest.approx(0.1)
    worst = max(plane[0] + x * a + y * b for x, y in apexes[:4, :2])
    assert coplanarity(apexes, plane) == pytest.approx(worst / np.sqrt(1 + a * a + b * b))


def test_the_regression_plane_goes_through_the_highest_apex_even_if_another_stands_out_of_it():
    """Apexes on a slope: the one that is highest above the best plane is not the one farthest from the substrate."""
    apexes = square(0.0, 0.2, 0.2, 0.0, 0.16)
    plane = regression_plane(apexes)
    above = apexes[:, 2] - plane[0] - apexes[:, :2] @ plane[1:]
    assert above[4] > above[1] + 1e-3  # stands out
    assert max(abs(above[1]), abs(above[2])) < 1e-2
    assert min(abs(above[1]), abs(above[2])) < 1e-12


@pytest.mark.parametrize("plane", [(0.3, 0.0, 0.0), (0.3, 0.01, -0.02)])
def test_apexes_in_one_plane_stand_on_it(plane):
    xy = np.stack(np.meshgrid(np.linspace(-1, 1, 4), np.linspace(-1, 1, 4)), axis=-1).reshape(-1, 2)
    apexes = np.column_stack([xy, plane[0] + xy @ plane[1:]])
    found = seating_planes(apexes, CENTRE)
    np.testing.assert_allclose(found, [plane] * len(found), atol=1e-9)
    assert coplanarity(apexes, found) < 1e-9
    with pytest.raises(InputError, match="no three apexes of the"):
        seating_planes(apexes, np.array([5.0, 0.0]))


def test_a_package_that_would_fall_over_is_told():
    with pytest.raises(InputError, match="no three apexes of the"):
        seating_planes(square(0.0, 0.1, 0.0, 0.1), np.array([5.0, 0.0]))


def test_fewer_than_three_apexes_or_a_row_of_them_carry_nothing():
    for apexes in (square(0.0, 0.1), np.column_stack([np.arange(5.0), np.arange(5.0), np.zeros(5)])):
        with pytest.raises(InputError, match="on one line"):
            seating_planes(apexes, CENTRE)


@pytest.mark.parametrize("seed", range(4))
def test_a_whole_array_rests_on_the_planes_that_its_definition_names(seed):
    """Brute force over all triples of a bowed 6 x 7 array: no apex above, and the triangle encloses the centre.

    By the definition's own words and without a hull: barycentric coordinates of the centre that are not negative. It is
    placed so that no line through two balls passes within a tie of it.
    """
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(0.8 * np.arange(7), 0.8 * np.arange(6))
    z = 0.01 * rng.standard_normal(x.shape) - 0.002 * ((x - 2.4) ** 2 + (y - 2) ** 2)
    apexes, centre = np.column_stack([x.ravel(), y.ravel(), z.ravel()]), np.array([2.437, 2.061])
    found = []
    for corners in apexes[np.array(list(combinations(range(len(apexes)), 3)))]:
        matrix = np.vstack([corners[:, :2].T, np.ones(3)])
        if abs(np.linalg.det(matrix)) < 1e-9 or np.linalg.solve(matrix, [*centre, 1]).min() < 0:
            continue
        plane = np.linalg.solve(matrix.T, corners[:, 2])  # a, b, c
        if np.all(plane[:2] @ apexes[:, :2].T + plane[2] - apexes[:, 2] > -1e-12):
            found.append(plane[[2, 0, 1]])
    (best,) = found
    (plane,) = seating_planes(apexes, centre)
    np.testing.assert_allclose(plane, best, atol=1e-9)
    distances = (best[0] + apexes[:, :2] @ best[1:] - apexes[:, 2]) / np.linalg.norm([1, *best[1:]])
    assert coplanarity(apexes, plane) == pytest.approx(distances.max())


@settings(max_examples=40)
@given(
    turn=st.floats(-3, 3), shift=st.tuples(*[st.floats(-20, 20)] * 3), seed=st.integers(0, 2**32 - 1),
)  # fmt: skip
def test_coplanarity_is_the_same_wherever_the_package_lies_and_however_its_balls_are_numbered(turn, shift, seed):
    rng = np.random.default_rng(seed)
    apexes = np.column_stack([rng.uniform(-1, 1, (12, 2)), 0.05 * rng.standard_normal(12)])
    try:
        seated = coplanarity(apexes, seating_planes(apexes, CENTRE))
    except InputError:
        return
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    moved = np.column_stack([apexes[:, :2] @ rotation.T, apexes[:, 2]])[rng.permutation(12)] + shift
    assert coplanarity(moved, seating_planes(moved, np.array(shift[:2]))) == pytest.approx(seated, abs=1e-9)
    regression = coplanarity(apexes, regression_plane(apexes))
    assert coplanarity(moved, regression_plane(moved)) == pytest.approx(regression, abs=1e-9)
    scaled = apexes * [1, 1, 3e-3]  # so flat that perpendicular and vertical are one
    flat = apexes * [1, 1, 1e-3]
    tall = coplanarity(scaled, seating_planes(scaled, CENTRE))
    assert tall == pytest.approx(3 * coplanarity(flat, seating_planes(flat, CENTRE)), rel=1e-5)
