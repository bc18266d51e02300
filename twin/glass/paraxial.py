"""First-order optics of a prescription, from the product of its surfaces' matrices."""

from collections.abc import Iterable
from dataclasses import dataclass
from math import atan, sin

import numpy as np

from .glasses import index
from .prescription import Prescription

DESIGN_WAVELENGTH_UM = 0.525


@dataclass(frozen=True)
class Pupil:
    """The stop as one end of the path sees it."""

    z: float  # in path coordinates
    magnification: float  # against the stop; negative is upside down
    radius: float


@dataclass(frozen=True)
class Paraxial:
    """Lengths in mm. Magnification is that of the chief ray between z = 0 and the image where it stands."""

    entrance: Pupil
    exit: Pupil
    magnification: float
    na: float  # on the specimen's side
    na_image: float
    focal_length: float  # of the whole path
    pinhole_focal_length: float  # of the pinhole in the entrance pupil that the path amounts to
    pinhole_focal_length_px: tuple[float, float]  # (columns, rows)
    px_per_mm: tuple[float, float]  # (columns, rows), on the specimen
    focus_z: float  # of the plane that is sharp in the image
    specimen_to_image: float


def paraxial(prescription: Prescription, wavelength_um: float = DESIGN_WAVELENGTH_UM) -> Paraxial:
    """First-order summary of a path."""
    stop, n = prescription.stop, len(prescription.surfaces)
    z_image = float(prescription.vertices[-1])
    front = _matrix(prescription, range(stop), wavelength_um) @ _transfer(prescription.working_distance)
    rear = _matrix(prescription, range(stop, n), wavelength_um)
    # A ray that crosses the pupil at height h crosses the stop at h / magnification, whatever its angle.
    entrance_z = float(front[0, 1] / front[0, 0])
    entrance = Pupil(entrance_z, float(1 / front[0, 0]), float(prescription.stop_radius / abs(front[0, 0])))
    exit_z = z_image - float(rear[0, 1] / rear[1, 1])
    exit = Pupil(exit_z, float(1 / rear[1, 1]), float(prescription.stop_radius / abs(rear[1, 1])))
    whole = rear @ front
    magnification = float(whole[0, 0] - whole[0, 1] / entrance_z)
    pinhole = abs(magnification) * entrance_z
    pitch = prescription.image.pitch
    return Paraxial(
        entrance=entrance,
        exit=exit,
        magnification=magnification,
        na=sin(atan(entrance.radius / abs(entrance_z))),
        na_image=sin(atan(exit.radius / abs(z_image - exit_z))),
        focal_length=float(-1 / whole[1, 0]),
        pinhole_focal_length=pinhole,
        pinhole_focal_length_px=(pinhole / pitch[0], pinhole / pitch[1]),
        px_per_mm=(abs(magnification) / pitch[0], abs(magnification) / pitch[1]),
        focus_z=float(whole[0, 1] / whole[0, 0]),
        specimen_to_image=z_image,
    )


def marginal_heights(prescription: Prescription, wavelength_um: float = DESIGN_WAVELENGTH_UM) -> np.ndarray:
    """Height at each surface of the ray from the origin through the stop's edge, (n,): half the width of a pencil."""
    heights = np.array([matrix[0, 1] for matrix in _from_specimen(prescription, wavelength_um)])
    return np.abs(heights) * prescription.stop_radius / abs(heights[prescription.stop])


def chief_heights(prescription: Prescription, wavelength_um: float = DESIGN_WAVELENGTH_UM) -> np.ndarray:
    """Height at each surface, (n,), of the ray from height 1 on the specimen through the middle of the stop."""
    matrices = _from_specimen(prescription, wavelength_um)
    at_stop = matrices[prescription.stop]
    slope = -at_stop[0, 0] / at_stop[0, 1]
    return np.array([matrix[0, 0] + matrix[0, 1] * slope for matrix in matrices])


def _from_specimen(prescription: Prescription, wavelength_um: float) -> list[np.ndarray]:
    """For each surface what takes (height, slope) from z = 0 to its vertex, (2, 2)."""
    start = _transfer(prescription.working_distance)
    return [_matrix(prescription, range(k), wavelength_um) @ start for k in range(len(prescription.surfaces))]


def _matrix(prescription: Prescription, surfaces: Iterable[int], wavelength_um: float) -> np.ndarray:
    """Takes (height, slope) before the first of ``surfaces`` to the vertex behind the last of them, (2, 2)."""
    product = np.eye(2)
    for k in surfaces:
        surface = prescription.surfaces[k]
        before, behind = (index(glass, wavelength_um) for glass in prescription.glasses[k])
        refraction = np.array([[1.0, 0.0], [surface.curvature * (before - behind) / behind, before / behind]])
        product = _transfer(surface.thickness) @ refraction @ product
    return product


def _transfer(distance: float) -> np.ndarray:
    return np.array([[1.0, distance], [0.0, 1.0]])
