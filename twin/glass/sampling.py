"""A path as the renderer uses it: rays of pixels towards the specimen, and of scene points towards the mirrors.

Radiometry. The sensor's irradiance is radiance integrated over the stop with the projected solid angle of each of its
parts; a white mirror array is taken to shine into the whole stop with constant radiance, and lights a scene point by
the solid angle of each part. Both are given relative to the middle of the field, so that natural vignetting is in the
weights and a mean over uniform samples of the stop is the integral.
"""

from dataclasses import dataclass, replace
from math import pi, sqrt
from typing import Any

import numpy as np

from ..in_memory import in_memory
from ..renderer import dr
from .aiming import MARGIN, Aim, fit_aim
from .paraxial import chief_heights, marginal_heights, paraxial
from .placed import PlacedImage, PlacedPath
from .prescription import Prescription
from .trace import Crossing, Rays, follow, image_in_memory, image_point, land, lens_surfaces, rays_through, way

CLEARANCE = 0.2  # mm between a pencil of first-order optics and a rim that need not be looked at


@dataclass(frozen=True, eq=False)
class SampledPath:
    """The surfaces of a placed path, its image, and the polynomials that aim at its stop.

    All is for arrays of one kind and of the direction of ``aim``.
    """

    crossings: tuple[Crossing, ...]
    image: PlacedImage
    aim: Aim

    def from_image(self, x: Any, y: Any, disk_x: Any, disk_y: Any, wavelength_um: Any) -> tuple[Rays, Any]:
        """The ray from the image's (x, y), mm, through a point of the stop, as it leaves towards the specimen.

        The stop is the unit disk. The weight is relative to the middle of the image and of the stop.
        """
        point = image_point(self.image, x, y)
        to_x, to_y, weight = self.aim(point, disk_x, disk_y)
        start = rays_through(*point, to_x, to_y, self.aim.pupil.z, outwards=False)
        rays, passed = follow(self.crossings, start, wavelength_um, outwards=False)
        return rays, weight * passed

    def from_specimen(
        self, x: Any, y: Any, z: Any, disk_x: Any, disk_y: Any, wavelength_um: Any
    ) -> tuple[tuple[Any, Any], tuple[Any, Any], Any]:
        """The ray from (x, y, z), path coordinates, through a point of the stop to the image.

        Returns where in the entrance pupil's plane it heads for, (x, y), where it lands, (x, y) mm on the image, and
        the solid angle of that part of the stop against the same part seen from the origin.
        """
        to_x, to_y, area = self.aim((x, y, z), disk_x, disk_y)
        start = rays_through(x, y, z, to_x, to_y, self.aim.pupil.z, outwards=True)
        rays, passed = follow(self.crossings, start, wavelength_um, outwards=True)
        # Solid angle: area times cos³ over the square of the distance between the planes.
        nearness = self.aim.pupil.z / (self.aim.pupil.z - z)
        weight = area * passed * dr.square(nearness) * start.n * dr.square(start.n)
        return (to_x, to_y), land(self.image, rays), weight


def sample_path(path: PlacedPath, kind: Any, outwards: bool, nodes: int) -> SampledPath:
    """The path for rays from the specimen (``outwards``) or from the image, each pencil sampled by ``nodes`` rays.

    What differs from instrument to instrument lies in memory for arrays of ``kind``: kernels are the same for all.

    A ray stands for its share of the stop: where a rim cuts through that share, a part of its light passes.
    """
    cell = sqrt(pi / nodes)  # the side of a ray's share of the unit disk
    widths = cell * marginal_heights(path.prescription)
    rims = {k: float(widths[k]) for k in _near_rims(path.prescription)}
    aim = fit_aim(path, outwards)
    coefficients = [[in_memory(kind, value) for value in row] for row in aim.coefficients]
    return SampledPath(
        way(path, kind, outwards, lens_surfaces(path), rims),
        image_in_memory(path.image, kind),
        replace(aim, coefficients=coefficients),
    )


def _near_rims(prescription: Prescription) -> list[int]:
    """Surfaces whose rims the pencils of the image's corners come near to."""
    image = prescription.image
    corner = MARGIN * np.hypot(image.width, image.height) / 2 / abs(paraxial(prescription).magnification)
    reach = corner * np.abs(chief_heights(prescription)) + marginal_heights(prescription) + CLEARANCE
    rims = [surface.semi_diameter for surface in prescription.surfaces]
    return [k for k in np.flatnonzero(reach > rims).tolist() if k != prescription.stop]
