"""Claims about the ball grid array."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import norm

from greenough.instrument.errors import InputError
from greenough.scenes.bga import DEFECTIVE_LOW, DEFECTIVE_MISSING, NOMINAL, bga, defective_bga

EXACT = replace(NOMINAL, diameter_tolerance=0.0, height_tolerance=0.0)


@pytest.fixture(scope="module")
def specimen():
    return bga(seed=3)


def balls_of(specimen):
    """Facets' corners (balls, facets, 3, 3)."""
    part = specimen.parts[1]
    count = len(specimen.as_built["ball_row"])
    return part.vertices[part.faces].reshape(count, -1, 3, 3)


def sagitta(specimen) -> float:
    """Largest distance between a facet's plane and its sphere, mm."""
    corners = balls_of(specimen)
    centre, radius = specimen.as_built["ball_centres_mm"], specimen.as_built["ball_radii_mm"]
    normal = np.cross(corners[:, :, 1] - corners[:, :, 0], corners[:, :, 2] - corners[:, :, 0])
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    depth = np.sum((corners[:, :, 0] - centre[:, None]) * normal, axis=-1)
    assert depth.max() <= radius.max()  # planes cut the spheres, looking outwards
    return float((radius[:, None] - depth).max())


def test_facets_depart_from_their_spheres_by_less_than_a_tenth_of_a_micrometre(specimen):
    assert sagitta(specimen) < 1e-4


@pytest.mark.parametrize(("diameter", "height"), [(0.45, 0.35), (0.45, 0.44), (0.55, 0.35), (0.55, 0.45)])
def test_so_do_the_extreme_balls_of_the_tolerance(diameter, height):
    assert sagitta(bga(0, nominal=replace(EXACT, rows=1, cols=1, diameter=diameter, height=height))) < 1e-4


def test_balls_are_spheres_that_stand_on_the_substrate(specimen):
    corners, built = balls_of(specimen), specimen.as_built
    distance = np.linalg.norm(corners - built["ball_centres_mm"][:, None, None], axis=-1)
    np.testing.assert_allclose(distance, np.broadcast_to(built["ball_radii_mm"][:, None, None], distance.shape))
    base = specimen.nominal["substrate_z_mm"]
    np.testing.assert_allclose(corners[..., 2].min(axis=(1, 2)), base, atol=1e-12)
    np.testing.assert_allclose(corners[..., 2].max(axis=(1, 2)), built["ball_apexes_mm"][:, 2])
    np.testing.assert_allclose(built["ball_apexes_mm"][:, 2] - base, built["ball_heights_mm"])
    np.testing.assert_allclose(specimen.parts[0].vertices[:, 2], base)


def test_normals_point_away_from_the_centres(specimen):
    part, built = specimen.parts[1], specimen.as_built
    vertices = part.vertices.reshape(len(built["ball_radii_mm"]), -1, 3)
    expected = (vertices - built["ball_centres_mm"][:, None]) / built["ball_radii_mm"][:, None, None]
    np.testing.assert_allclose(part.normals.reshape(expected.shape), expected, atol=1e-12)


def test_an_exact_array_has_the_drawing_s_dimensions():
    built = bga(0, nominal=EXACT).as_built
    np.testing.assert_allclose(built["ball_radii_mm"], 0.25)
    np.testing.assert_allclose(built["ball_heights_mm"], 0.4)
    np.testing.assert_allclose(built["ball_centres_mm"][:, 2] + 0.2, 0.15)  # equator over the substrate
    grid = built["ball_centres_mm"].reshape(7, 9, 3)
    np.testing.assert_allclose(np.diff(grid[..., 0], axis=1), 0.8)
    np.testing.assert_allclose(np.diff(grid[..., 1], axis=0), -0.8)
    np.testing.assert_allclose(grid.mean(axis=(0, 1))[:2], 0, atol=1e-12)


def test_diameters_and_heights_scatter_by_a_third_of_their_tolerance_and_stay_within_it():
    boards = [bga(seed, nominal=replace(NOMINAL, rows=40, cols=1, pitch=0.15)) for seed in range(3)]
    diameters = 2 * np.concatenate([each.as_built["ball_radii_mm"] for each in boards])
    heights = np.concatenate([each.as_built["ball_heights_mm"] for each in boards])
    for value, middle in [(diameters, 0.5), (heights, 0.4)]:
        deviation = (value - middle) / 0.05
        assert np.abs(deviation).max() <= 1 + 1e-9
        # Mean and spread within what chance allows once in a million; the cut at 3 sd changes the spread by < 1 %.
        limit = norm.isf(0.5e-6)
        n = len(deviation)
        assert abs(deviation.mean()) < limit / 3 / np.sqrt(n)
        assert abs(deviation.std() * 3 - 1) < limit / np.sqrt(2 * n) + 0.01


def test_seeds_tell_arrays_apart_and_repeat_them(specimen):
    np.testing.assert_array_equal(bga(3).parts[1].vertices, specimen.parts[1].vertices)
    assert (bga(4).as_built["ball_radii_mm"] != specimen.as_built["ball_radii_mm"]).all()


def test_a_missing_and_a_low_ball_leave_the_others_alone(specimen):
    built = specimen.as_built
    changed = bga(3, missing=[(0, 1)], low={(2, 5): 0.1}).as_built
    kept = np.delete(np.arange(63), 1)
    np.testing.assert_array_equal(changed["ball_row"], built["ball_row"][kept])
    np.testing.assert_array_equal(changed["ball_col"], built["ball_col"][kept])
    np.testing.assert_array_equal(changed["ball_radii_mm"], built["ball_radii_mm"][kept])
    lower = built["ball_heights_mm"][kept] - changed["ball_heights_mm"]
    expected = np.where((built["ball_row"] == 2) & (built["ball_col"] == 5), 0.1, 0.0)[kept]
    np.testing.assert_allclose(lower, expected, atol=1e-15)


def test_the_array_fills_the_measuring_volume_however_it_is_laid(specimen):
    def reach(cols: int, rows: int) -> np.ndarray:
        """Farthest point of the largest balls in x and y, laid 2 sd of the hand's 0.1 mm and 1° off."""
        corner, turn = np.array([cols - 1, rows - 1]) / 2 * NOMINAL.pitch, np.deg2rad(2.0)
        largest = (NOMINAL.diameter + NOMINAL.diameter_tolerance) / 2
        return np.cos(turn) * corner + np.sin(turn) * corner[::-1] + largest + 0.2

    half = np.array([8.0, 6.0]) / 2
    assert (reach(NOMINAL.cols, NOMINAL.rows) < half).all()
    assert reach(NOMINAL.cols + 1, NOMINAL.rows)[0] > half[0]
    assert reach(NOMINAL.cols, NOMINAL.rows + 1)[1] > half[1]
    substrate, balls = (np.abs(part.vertices[:, :2]).max(axis=0) for part in specimen.parts)
    assert (balls < substrate).all()


@pytest.mark.parametrize(
    ("wrong", "sentence"),
    [
        ({"missing": [(7, 0)]}, "rows are 0 to 6"),
        ({"low": {(0, -1): 0.1}}, "columns 0 to 8"),
        ({"low": {(0, 0): 0.39}}, r"can be made 0 to 0\.\d+ mm lower"),
        ({"low": {(0, 0): -0.1}}, r"can be made 0 to 0\.\d+ mm lower"),
        ({"nominal": replace(NOMINAL, height=0.5)}, "would float"),
    ],
)
def test_an_impossible_array_is_refused(wrong, sentence):
    with pytest.raises(InputError, match=sentence):
        bga(0, **wrong)


def test_the_defective_array_is_the_sound_one_but_for_one_missing_and_one_low_ball(specimen):
    defective, built = defective_bga(3), specimen.as_built
    (missing,), ((low, depth),) = DEFECTIVE_MISSING, DEFECTIVE_LOW.items()
    balls = list(zip(built["ball_row"], built["ball_col"], strict=True))
    heights = dict(zip(balls, built["ball_heights_mm"], strict=True))
    found = defective.as_built
    seen = list(zip(found["ball_row"], found["ball_col"], strict=True))
    assert set(balls) - set(seen) == {missing}
    for ball, height in zip(seen, found["ball_heights_mm"], strict=True):
        assert height == pytest.approx(heights[ball] - (depth if ball == low else 0.0))
