"""Spheres that stand in a plane: what balls of solder and mounted balls of ceramic have in common."""

import numpy as np

from .parts import Part
from .triangulation import ring_angles, ring_faces


def truncated_spheres(centres: np.ndarray, radii: np.ndarray, base: float, edge: float, material: str) -> Part:
    """Spheres cut off at a plane z = ``base``, their upper parts with the true normals.

    Rings of equal polar angle from the apex down. The facets' sagitta over a sphere is about edge² / (6 radius): that
    of an equilateral triangle's corners against its middle.

    Parameters
    ----------
    centres : (balls, 3)
        mm.
    radii : (balls,)
        mm.
    base : float
        z of the plane, mm.
    edge : float
        Length of a facet's sides on the largest, mm.
    material : str
        Of all.
    """
    cut = np.arccos(np.maximum(-1.0, (base - centres[:, 2]) / radii))  # polar angle where the plane begins
    # One triangulation for all: fine enough for the largest ball and stretched to each ball's own cut.
    rings = int(np.ceil((radii * cut).max() / edge))
    share = np.arange(rings + 1) / rings
    girth = 2 * np.pi * np.max(radii[:, None] * np.sin(share * cut[:, None]), axis=0)
    counts = [1, *np.maximum(6, np.ceil(girth[1:] / edge)).astype(int).tolist()]
    azimuth = ring_angles(counts)
    polar = np.repeat(share, counts) * cut[:, None]  # (balls, points)
    normals = np.stack([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)], axis=-1)
    vertices = centres[:, None] + radii[:, None, None] * normals
    faces = ring_faces(counts) + np.arange(len(radii))[:, None, None] * len(azimuth)
    return Part(vertices.reshape(-1, 3), faces.reshape(-1, 3).astype(np.int32), normals.reshape(-1, 3), material)
