"""Claims about the balls for probing and spacing errors."""

from collections.abc import Sequence
from itertools import product

import numpy as np
import pytest

from greenough.scenes.spheres import DIAMETER_MM, PAIR_DIAMETER_MM, SPACING_MM, sphere, two_spheres

VOLUME_MM = (8.0, 6.0, 3.0)
DIAGONAL_MM = float(np.linalg.norm(VOLUME_MM))
CAP_DEG = 60.0


@pytest.mark.parametrize("part", [sphere(3), two_spheres(3)])
def test_balls_have_the_certified_diameters_and_places(part):
    _, balls = part.parts
    diameters, centres = part.as_built["sphere_diameters_mm"], part.as_built["sphere_centres_mm"]
    distance = np.linalg.norm(balls.vertices.reshape(len(centres), -1, 3) - centres[:, None], axis=-1)
    np.testing.assert_allclose(distance, np.broadcast_to(diameters[:, None] / 2, distance.shape))


def test_sizes_are_those_recommended_for_the_volume():
    for diameter in (DIAMETER_MM, PAIR_DIAMETER_MM):
        assert 0.1 * DIAGONAL_MM < diameter < 0.2 * DIAGONAL_MM  # by either edition
    assert SPACING_MM > 0.3 * DIAGONAL_MM


def test_the_spacing_is_that_of_the_centres_and_no_nominal_one():
    spacings = []
    for seed in range(20):
        built = two_spheres(seed).as_built
        between = built["sphere_centres_mm"][1] - built["sphere_centres_mm"][0]
        np.testing.assert_allclose(np.linalg.norm(between), built["spacing_mm"])
        np.testing.assert_allclose(between[1:], 0)
        spacings.append(float(built["spacing_mm"]))
    assert 1e-3 < np.std(spacings) < 1e-2
    assert abs(np.mean(spacings) - SPACING_MM) < 5e-3


def test_facets_depart_from_the_balls_by_less_than_a_twentieth_of_a_micrometre():
    part = sphere(0)
    corners = part.parts[1].vertices[part.parts[1].faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    depth = np.sum((corners[:, 0] - part.as_built["sphere_centres_mm"][0]) * normal, axis=-1)
    assert part.as_built["sphere_diameters_mm"][0] / 2 - depth.min() < 5e-5


@pytest.mark.parametrize("part", [sphere(0), two_spheres(0)])
def test_the_cap_is_in_the_middle_of_the_range(part):
    z, radius = part.as_built["sphere_centres_mm"][0, 2], part.nominal["diameter_mm"] / 2
    np.testing.assert_allclose(z + radius, -(z + radius * np.cos(np.radians(CAP_DEG))))


def shadowed(part, directions: Sequence[np.ndarray]) -> np.ndarray:
    """Which vertices (n,) of caps lie in the carrier's or the other ball's way to any of some directions."""
    centres, radii = part.as_built["sphere_centres_mm"], part.as_built["sphere_diameters_mm"] / 2
    balls = part.parts[1]
    points = balls.vertices[balls.normals[:, 2] > np.cos(np.radians(CAP_DEG))]
    hidden = np.zeros(len(points), bool)
    for direction in directions:
        for centre, radius in zip(centres, radii, strict=True):
            offset = centre - points
            along = offset @ direction
            aside = np.linalg.norm(offset - along[:, None] * direction, axis=-1)
            hidden |= (along > radius) & (aside < radius)  # its own ball is never ahead by more than the radius
        assert direction[2] > 0  # the carrier is below
    return hidden


def test_no_ball_shades_the_other_s_cap_however_the_bar_is_tilted():
    directions = []
    for tilt, side in product((-37, 0, 37), (-6, 6)):
        angle = np.radians(tilt + side)
        directions.append(np.array([np.sin(angle), 0.0, np.cos(angle)]))
    assert not shadowed(two_spheres(1), directions).any()
    flat = np.radians(87.0)  # as a control: nearly along the bar the one is behind the other
    assert shadowed(two_spheres(1), [np.array([np.sin(flat), 0.0, np.cos(flat)])]).any()
