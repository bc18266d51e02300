"""A surface from a cloud whose points remember their pixels: neighbours in the camera become triangles."""

import numpy as np

from greenough.instrument.errors import InputError

from .point_cloud import Mesh, PointCloud

_LONGEST = 6.0  # times the middle length of edges: longer ones bridge what the camera did not see
_MAX_PIXELS = 2**27  # of the camera that the pixels claim


def surface_mesh(cloud: PointCloud) -> Mesh:
    """Triangles between neighbouring pixels, with their normals towards +z.

    A square of four points becomes two triangles and one of three points becomes one. What spans a void, or a step that
    is steep as seen from the camera, stays open.

    Raises
    ------
    InputError
        When the points do not say which pixels they are of, or no three of them are neighbours.
    """
    if cloud.pixels is None:
        raise InputError("the cloud does not say which pixels its points are of: write it by `greenough measure`")
    pixels = cloud.pixels.astype(np.int64)
    first = pixels.min(axis=0)
    rows, cols = (int(size) for size in pixels.max(axis=0) - first + 1)
    if rows * cols > _MAX_PIXELS:
        raise InputError(f"the cloud claims a camera of {cols} x {rows} pixels; at most {_MAX_PIXELS} are taken")
    number = np.full((rows, cols), -1, dtype=np.int32)
    number[tuple((pixels - first).T)] = np.arange(len(cloud.xyz), dtype=np.int32)
    there = (number >= 0).astype(np.uint8)
    corners = there[:-1, :-1] + there[:-1, 1:] + there[1:, 1:] + there[1:, :-1]  # of each square
    whole, partial = (_squares(number, *np.nonzero(corners == count)) for count in (4, 3))
    of_three = partial[partial >= 0].reshape(-1, 3)  # in their order around the square
    faces = np.concatenate([whole[:, [0, 1, 2]], whole[:, [0, 2, 3]], of_three])
    sides = cloud.xyz[faces] - cloud.xyz[np.roll(faces, -1, axis=1)]
    lengths = np.linalg.norm(sides, axis=2)
    kept = (lengths < _LONGEST * np.median(lengths)).all(axis=1) if len(faces) else np.zeros(0, bool)
    if not kept.any():
        raise InputError("no three points of the cloud are neighbours in the camera: there is no surface")
    faces, sides = faces[kept], sides[kept]
    upwards = np.cross(sides[:, 0], sides[:, 1])[:, 2].sum() > 0
    return Mesh(cloud.xyz, faces if upwards else faces[:, ::-1])


def _squares(number: np.ndarray, row: np.ndarray, col: np.ndarray) -> np.ndarray:
    """Points (n, 4) at the corners of squares, around each; ``row`` and ``col`` are of their first corners."""
    return np.stack([number[row, col], number[row, col + 1], number[row + 1, col + 1], number[row + 1, col]], axis=-1)


def surface_normals(cloud: PointCloud) -> np.ndarray:
    """Unit normals of the points of a surface, (n, 3) float32; zero where a point has no triangle.

    The normals of the triangles around a point are averaged by area. Nothing else is smoothed: the noise of neighbours
    is in them.

    Raises
    ------
    InputError
        As `surface_mesh`.
    """
    mesh = surface_mesh(cloud)
    corners = mesh.vertices[mesh.faces]
    doubled_areas = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = np.empty_like(mesh.vertices)
    for axis in range(3):
        around = (np.bincount(mesh.faces[:, k], doubled_areas[:, axis], len(normals)) for k in range(3))
        normals[:, axis] = sum(around)
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.divide(normals, lengths, out=np.zeros_like(normals), where=lengths > 0).astype(np.float32)
