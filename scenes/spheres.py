"""Matte ceramic balls on a dark carrier: one sphere for the probing error, two for the spacing error.

VDI/VDE 2634-2 asks for spheres of 0.02 to 0.2 and a spacing of at least 0.3 of the measuring volume's body diagonal.
The centres of the two lie on the x axis of the part's frame, near z = ``CENTRE_Z_MM``, so that caps up to 60 degrees
of slope are in the middle of the measuring range. Each ball is sunk into the carrier, which is so dark that it hardly
lights them. Diameters and places are as their certificate says; their form is perfect.
"""

import numpy as np

from .parts import Part, Specimen
from .triangulation import grid_faces, grid_points
from .truncated_spheres import truncated_spheres

DIAMETER_MM = 1.5
SPACING_MM = 4.0
CENTRE_Z_MM = -0.5625  # the cap up to 60 degrees, half a radius high, is centred on z = 0

_DIAMETER_SD_MM = 1e-3
_SPACING_SD_MM = 5e-3
_CARRIER_BELOW_MM = 0.4  # under the centres: all that the lenses see of a ball is above
_MARGIN_MM = 0.45  # of the carrier around the balls
_EDGE_MM = 0.01  # length of a facet's sides


def sphere(seed: int) -> Specimen:
    """One ball in the middle.

    ``as_built``: ``sphere_diameters_mm`` (1,), ``sphere_centres_mm`` (1, 3).
    """
    diameter = DIAMETER_MM + _DIAMETER_SD_MM * np.random.default_rng(seed).standard_normal(1)
    return _mounted("sphere", np.zeros(1), diameter, {"diameter_mm": DIAMETER_MM})


def two_spheres(seed: int) -> Specimen:
    """Two balls at a calibrated distance, the first on the left.

    ``as_built``: ``sphere_diameters_mm`` (2,), ``sphere_centres_mm`` (2, 3), ``spacing_mm`` ().
    """
    rng = np.random.default_rng(seed)
    diameters = DIAMETER_MM + _DIAMETER_SD_MM * rng.standard_normal(2)
    spacing = SPACING_MM + _SPACING_SD_MM * rng.standard_normal()
    x = np.array([-0.5, 0.5]) * spacing
    return _mounted("two-spheres", x, diameters, {"diameter_mm": DIAMETER_MM, "spacing_mm": SPACING_MM})


def _mounted(name: str, x: np.ndarray, diameters: np.ndarray, nominal: dict[str, float]) -> Specimen:
    """Balls with centres at ``x`` (balls,) on their carrier."""
    centres = np.column_stack([x, np.zeros(len(x)), np.full(len(x), CENTRE_Z_MM)])
    base = CENTRE_Z_MM - _CARRIER_BELOW_MM
    balls = truncated_spheres(centres, diameters / 2, base, _EDGE_MM, "ceramic")
    as_built = {"sphere_diameters_mm": diameters, "sphere_centres_mm": centres}
    if len(x) == 2:
        as_built["spacing_mm"] = np.array(x[1] - x[0])
    return Specimen(name, (_carrier(x, base), balls), nominal, as_built)


def _carrier(x: np.ndarray, z: float) -> Part:
    reach = DIAMETER_MM / 2 + _MARGIN_MM
    xy = grid_points(np.array([x.min() - reach, x.max() + reach]), np.array([-reach, reach]))
    return Part(
        np.column_stack([xy, np.full(len(xy), z)]), grid_faces(2, 2), np.tile([0.0, 0.0, 1.0], (len(xy), 1)), "ink"
    )
