"""Claims about spheres that stand in a plane."""

import numpy as np
import pytest

from greenough.scenes.truncated_spheres import truncated_spheres

CENTRES = np.array([[0.0, 0.0, 0.1], [2.0, -1.0, 0.3]])
RADII = np.array([0.5, 0.4])
EDGE = 0.02


@pytest.fixture(scope="module")
def part():
    return truncated_spheres(CENTRES, RADII, base=0.0, edge=EDGE, material="ceramic")


def test_vertices_lie_on_their_spheres_above_the_plane_and_normals_point_outwards(part):
    vertices = part.vertices.reshape(2, -1, 3)
    outwards = (vertices - CENTRES[:, None]) / RADII[:, None, None]
    np.testing.assert_allclose(np.linalg.norm(outwards, axis=-1), 1)
    np.testing.assert_allclose(part.normals.reshape(2, -1, 3), outwards, atol=1e-12)
    np.testing.assert_allclose(vertices[..., 2].min(axis=1), 0.0, atol=1e-12)
    np.testing.assert_allclose(vertices[..., 2].max(axis=1), CENTRES[:, 2] + RADII)


def test_the_sagitta_is_that_of_equilateral_triangles(part):
    corners = part.vertices[part.faces].reshape(2, -1, 3, 3)
    normal = np.cross(corners[:, :, 1] - corners[:, :, 0], corners[:, :, 2] - corners[:, :, 0])
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    sagitta = RADII[:, None] - np.sum((corners[:, :, 0] - CENTRES[:, None]) * normal, axis=-1)
    assert sagitta.min() > 0  # planes cut the spheres, looking outwards
    # The corners of an equilateral triangle are edge / sqrt(3) from its middle.
    assert np.median(sagitta[0]) < 1.2 * EDGE**2 / (6 * RADII[0])
    # Where two rings differ in length, triangles are as large as right-angled ones of the same sides.
    assert sagitta.max() < EDGE**2 / (2 * RADII.min())
