"""Claims about the plane."""

import numpy as np

from greenough.scenes.plane import plane


def test_the_plane_is_flat_faces_up_and_is_larger_than_the_lit_field():
    (part,) = plane().parts
    assert (part.vertices[:, 2] == 0).all()
    assert part.normals is not None
    assert (part.normals == [0, 0, 1]).all()
    a, b, c = np.moveaxis(part.vertices[part.faces], 1, 0)
    assert (np.cross(b - a, c - a)[:, 2] > 0).all()
    assert (np.ptp(part.vertices[:, :2], axis=0) > [10.9, 6.2]).all()
