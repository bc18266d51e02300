"""Coplanarity of a package's terminals: how far the worst apex is from the plane that the package rests on.

Two planes are in use, both defined in JEDEC's JESD22-B108. The seating plane goes through the three apexes farthest
from the substrate whose triangle encloses the projection of the centre of gravity: the package stands on them. The
regression plane is the best plane through all apexes, moved to the apex that is farthest from the substrate; another
apex may stand out of it.

Apexes have z upwards, away from the substrate; planes (c, a, b) are z = c + a x + b y. Which apexes carry the package
hangs on the smallest sideways shift where three stand in a row: measured and true heights are to be compared at the
same (x, y).
"""

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from greenough.instrument.errors import InputError

TIE_MM = 0.01
"""A triangle that misses the centre of gravity by less counts too: above its edge or corner the package rocks from one
plane to the other, and the worst of them decides."""

_STEEPEST = 1e-6  # vertical facets of the hull carry nothing


def seating_planes(apexes: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """Planes (n, 3) that a package may rest on: several where its centre of gravity is above an edge or apex.

    Parameters
    ----------
    apexes : (balls, 3)
        Not all in one line. If all are in one plane, as equal heights are, it is the one.
    centre : (2,)
        Projection of the centre of gravity.

    Raises
    ------
    InputError
        If there are fewer than three apexes, they lie on one line, or no triangle of them encloses the centre: the
        package would fall over.
    """
    if len(apexes) < 3 or np.linalg.matrix_rank(apexes[:, :2] - apexes[0, :2], tol=TIE_MM) < 2:
        raise InputError(f"a package does not stand on {len(apexes)} apexes on one line: measure more of its terminals")
    try:
        hull = ConvexHull(apexes)
    except QhullError:  # flat: no body has a hull
        return _common_plane(apexes, centre)
    normals = hull.equations[:, :3]
    upper = normals[:, 2] > _STEEPEST
    corners = apexes[hull.simplices[upper]][..., :2]  # (facets, 3, 2)
    carrying = _outside(corners, centre) < TIE_MM
    if not carrying.any():
        raise _falls_over(len(apexes))
    nx, ny, nz, offset = hull.equations[upper][carrying].T
    return np.stack([-offset / nz, -nx / nz, -ny / nz], axis=-1)


def regression_plane(apexes: np.ndarray) -> np.ndarray:
    """Best plane (3,) through apexes (balls, 3), moved to the highest of them: z is the distance from the substrate."""
    design = np.column_stack([np.ones(len(apexes)), apexes[:, :2]])
    plane = np.linalg.lstsq(design, apexes[:, 2], rcond=None)[0]
    highest = np.argmax(apexes[:, 2])
    plane[0] += apexes[highest, 2] - design[highest] @ plane
    return plane


def _common_plane(apexes: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """The plane (1, 3) that all apexes (balls, 3) are in."""
    sides = ConvexHull(apexes[:, :2]).equations  # (sides, 3), normals outwards
    if (sides[:, :2] @ centre + sides[:, 2]).max() >= TIE_MM:
        raise _falls_over(len(apexes))
    return regression_plane(apexes)[None]


def coplanarity(apexes: np.ndarray, planes: np.ndarray) -> float:
    """Largest distance of an apex (balls, 3) from the planes (3,) or (n, 3), perpendicular to them, to either side."""
    c, a, b = np.atleast_2d(planes).T[..., None]
    below = (c + a * apexes[:, 0] + b * apexes[:, 1] - apexes[:, 2]) / np.sqrt(1 + a * a + b * b)
    return float(np.abs(below).max())


def _falls_over(balls: int) -> InputError:
    return InputError(
        f"no three apexes of the {balls} that were measured enclose the centre of gravity, so that the package "
        "would fall over: measure more of its terminals, or state another centre"
    )


def _outside(corners: np.ndarray, point: np.ndarray) -> np.ndarray:
    """How far a point lies beyond the sides of triangles (n, 3, 2), (n,); 0 inside."""
    sides = np.roll(corners, -1, axis=1) - corners
    turn = np.sign(_cross(sides[:, 0], sides[:, 1]))[:, None]
    inwards = turn * _cross(sides, point - corners) / np.linalg.norm(sides, axis=-1)
    return np.maximum(-inwards.min(axis=1), 0.0)


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Third component of the cross product of vectors in the plane (..., 2)."""
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
