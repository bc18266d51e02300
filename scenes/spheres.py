"""Matte ceramic balls on a dark carrier: one sphere for the probing error, two for the spacing error.

VDI/VDE 2634-2 asks for spheres of 0.02 to 0.2 and a spacing of at least 0.3 of the measuring volume's body diagonal.
The one is as large as that and the range of heights allow; the two are smaller, so that the bar can be tilted in the
range. Centres are so far below z = 0 that caps up to 60 degrees of slope, half a radius high, are in the middle of the
range; those of the two differ in x alone. Each ball is sunk into the carrier, which is so dark that it hardly lights
it. Diameters and places are as their certificate says; their form is perfect.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from .parts import Part, Specimen
from .triangulation import grid_faces, grid_points
from .truncated_spheres import truncated_spheres

DIAMETER_MM = 2.0
"""Of the one."""

PAIR_DIAMETER_MM = 1.5
"""Of each of the two."""

SPACING_MM = 4.0
CENTRE_Z_PER_DIAMETER = -0.375  # the cap's middle is 3/4 of a radius above it

_DIAMETER_SD_MM = 1e-3
_SPACING_SD_MM = 5e-3
_SUNK = 0.27  # of the diameter, the carrier under the centres: all that the lenses see of a ball is above
_MARGIN_MM = 0.45  # of the carrier around the balls
_EDGE_MM = 0.01  # length of a facet's sides


def sphere(seed: int) -> Specimen:
    """One ball in the middle.

    ``as_built``: ``sphere_diameters_mm`` (1,), ``sphere_centres_mm`` (1, 3).
    """
    diameter = DIAMETER_MM + _DIAMETER_SD_MM * np.random.default_rng(seed).standard_normal(1)
    return _mounted("sphere", np.zeros(1), diameter, DIAMETER_MM, {})


def two_spheres(seed: int) -> Specimen:
    """Two balls at a calibrated distance, the first on the left.

    ``as_built``: ``sphere_diameters_mm`` (2,), ``sphere_centres_mm`` (2, 3), ``spacing_mm`` ().
    """
    rng = np.random.default_rng(seed)
    diameters = PAIR_DIAMETER_MM + _DIAMETER_SD_MM * rng.standard_normal(2)
    spacing = SPACING_MM + _SPACING_SD_MM * rng.standard_normal()
    x = np.array([-0.5, 0.5]) * spacing
    known = {"spacing_mm": np.array(spacing)}
    mounted = _mounted("two-spheres", x, diameters, PAIR_DIAMETER_MM, known)
    return replace(mounted, nominal={**mounted.nominal, "spacing_mm": SPACING_MM})


def _mounted(
    name: str, x: np.ndarray, diameters: np.ndarray, nominal: float, known: Mapping[str, np.ndarray]
) -> Specimen:
    """Balls with centres at ``x`` (balls,) on their carrier; ``known`` is built beside their diameters and places."""
    z = CENTRE_Z_PER_DIAMETER * nominal
    centres = np.column_stack([x, np.zeros(len(x)), np.full(len(x), z)])
    base = z - _SUNK * nominal
    balls = truncated_spheres(centres, diameters / 2, base, _EDGE_MM, "ceramic")
    as_built = {"sphere_diameters_mm": diameters, "sphere_centres_mm": centres, **known}
    carrier = _carrier(x, nominal / 2 + _MARGIN_MM, base)
    return Specimen(name, (carrier, balls), {"diameter_mm": nominal}, as_built)


def _carrier(x: np.ndarray, reach: float, z: float) -> Part:
    xy = grid_points(np.array([x.min() - reach, x.max() + reach]), np.array([-reach, reach]))
    return Part(
        np.column_stack([xy, np.full(len(xy), z)]), grid_faces(2, 2), np.tile([0.0, 0.0, 1.0], (len(xy), 1)), "ink"
    )
