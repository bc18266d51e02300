"""A sampled path in the frame of Mitsuba's sensors and projectors, with the specimen's scale instead of the image's.

There the origin is the middle of the entrance pupil, z points to the specimen, and columns run along -x and rows
along -y. Path coordinates turn by half a circle about y. The image's pixels are counted by what they show on the
specimen, so that glass can take the place of an ideal lens without other numbers.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from ..renderer import mi
from .paraxial import paraxial
from .placed import errors_from_json, place
from .prescription import load_prescription
from .sampling import SampledPath, sample_path


@dataclass(frozen=True, eq=False)
class Mounting:
    """A path behind a plugin's interface."""

    sampled: SampledPath
    pupil_z: float
    magnification: float

    def ray(self, x: Any, y: Any, disk: Any, wavelength_um: Any) -> tuple[Any, Any, Any]:
        """Origin, direction and weight of the ray of a sensor's point that ideally sees (x, y) on the plane z = 0.

        x and y are mm along the columns and rows from the middle, ``disk`` is a point of the stop as the unit disk.
        """
        scale = self.magnification
        rays, weight = self.sampled.from_image(x * scale, y * -scale, disk.x, disk.y, wavelength_um)
        origin = mi.Point3f(-rays.x, rays.y, self.pupil_z - rays.z)
        return origin, mi.Vector3f(-rays.l, rays.m, -rays.n), weight

    def look_up(self, p: Any, disk: Any, wavelength_um: Any) -> tuple[Any, Any, Any, Any]:
        """Where in the pupil the ray from ``p`` heads for, what it meets, and the light it brings.

        What it meets is (x, y), mm along columns and rows from the middle of the image ideally projected onto z = 0.
        """
        scale = self.magnification
        pupil, image, weight = self.sampled.from_specimen(-p.x, p.y, self.pupil_z - p.z, disk.x, disk.y, wavelength_um)
        return mi.Point3f(-pupil[0], pupil[1], 0), image[0] / scale, image[1] / -scale, weight


@lru_cache(maxsize=8)
def mount(prescription: str, errors: str, outwards: bool, nodes: int) -> Mounting:
    """The path of a built-in prescription or a file, with ``errors`` as JSON (nothing: none), ready to be sampled.

    Raises InputError as ``load_prescription`` and ``errors_from_json`` do.
    """
    lens = load_prescription(prescription)
    path = place(lens, errors_from_json(errors, lens) if errors else None)
    summary = paraxial(lens)
    return Mounting(sample_path(path, mi.Float, outwards, nodes), summary.entrance.z, summary.magnification)
