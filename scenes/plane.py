"""A flat, diffuse plane, a little larger than what is lit."""

import numpy as np

from .parts import Part, Specimen
from .triangulation import grid_faces, grid_points

WIDTH_MM = 11.6
HEIGHT_MM = 7.0


def plane() -> Specimen:
    """The plane z = 0, 11.6 x 7.0 mm, ceramic."""
    xy = grid_points(np.array([-0.5, 0.5]) * WIDTH_MM, np.array([-0.5, 0.5]) * HEIGHT_MM)
    vertices = np.column_stack([xy, np.zeros(len(xy))])
    normals = np.tile([0.0, 0.0, 1.0], (len(xy), 1))
    part = Part(vertices, grid_faces(2, 2), normals, "ceramic")
    return Specimen("plane", (part,), {"width_mm": WIDTH_MM, "height_mm": HEIGHT_MM})
