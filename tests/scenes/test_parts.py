"""Claims about parts and what is done with them."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from greenough.scenes.bga import BallGrid, bga
from greenough.scenes.parts import Part, merge, transform

TRIANGLE = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
FACE = np.array([[0, 1, 2]], np.int32)


@pytest.mark.parametrize(
    ("vertices", "faces", "normals", "material"),
    [
        (TRIANGLE[:, :2], FACE, None, "ink"),
        (TRIANGLE, FACE[0], None, "ink"),
        (TRIANGLE, FACE, TRIANGLE[:2], "ink"),
        (TRIANGLE, FACE, None, "cheese"),
    ],
)
def test_a_part_of_wrong_shape_or_material_cannot_be_made(vertices, faces, normals, material):
    with pytest.raises(ValueError, match=r"must be|unknown material"):
        Part(vertices, faces, normals, material)


def test_a_moved_part_is_the_same_body_with_its_normals_turned():
    part = Part(TRIANGLE, FACE, np.tile([0.0, 0, 1], (3, 1)), "ink")
    motion = np.eye(4)
    motion[:3, :3] = Rotation.from_euler("xyz", [0.3, -0.8, 2.0]).as_matrix()
    motion[:3, 3] = [1, -2, 3]
    moved = transform(part, motion)
    np.testing.assert_allclose(moved.vertices[0], [1, -2, 3])
    side = moved.vertices[1:] - moved.vertices[0]
    np.testing.assert_allclose(np.linalg.norm(side, axis=-1), 1)
    assert moved.normals is not None
    np.testing.assert_allclose(moved.normals, np.tile(np.cross(side[0], side[1]), (3, 1)), atol=1e-15)


def test_merged_parts_keep_their_triangles():
    parts = bga(0, nominal=BallGrid(rows=1, cols=2)).parts
    vertices, faces = merge(parts)
    assert faces.dtype == np.int32
    np.testing.assert_array_equal(vertices[faces], np.concatenate([part.vertices[part.faces] for part in parts]))
