"""One instrument's lens paths as they were assembled, drawn from its seed."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from .aiming import aim_exactly
from .paraxial import DESIGN_WAVELENGTH_UM, paraxial
from .placed import PathErrors, PlacedPath, place
from .prescription import Prescription
from .trace import Double, image_point, trace


@dataclass(frozen=True)
class Tolerances:
    """Standard deviations per axis; 0 switches an error off."""

    decentre_mm: float = 0.03  # of each element
    tilt_deg: float = 0.05  # of each element
    image_tilt_deg: float = 0.3  # of the sensor or the mirrors
    focus_mm: float = 0.1  # of the sharp plane, at the specimen
    axis_deg: float = 0.2  # of the whole path
    pointing_mm: float = 0.05  # of the image's middle, at the specimen, after the paths were pointed there


@dataclass(frozen=True, eq=False)
class AssembledPath:
    """A path as it was built and where it stands."""

    path: PlacedPath
    errors: PathErrors  # of its elements and image
    twin_from_path: np.ndarray  # (4, 4)

    @property
    def twin_from_pupil(self) -> np.ndarray:
        """The frame (4, 4) of Mitsuba's sensors: from the entrance pupil's middle, z to the specimen, x to the left."""
        path_from_pupil = np.diag([-1.0, 1.0, -1.0, 1.0])
        path_from_pupil[2, 3] = paraxial(self.path.prescription).entrance.z
        return self.twin_from_path @ path_from_pupil


def draw_path_errors(prescription: Prescription, tolerances: Tolerances, rng: np.random.Generator) -> PathErrors:
    """Errors of elements and image, normally distributed."""

    def pair(sd: float) -> tuple[float, float]:
        x, y = sd * rng.standard_normal(2)
        return float(x), float(y)

    tilt, image_tilt = np.radians([tolerances.tilt_deg, tolerances.image_tilt_deg]).tolist()
    decentres = {element: pair(tolerances.decentre_mm) for element in prescription.elements}
    tilts = {element: pair(tilt) for element in prescription.elements}
    return PathErrors(decentres, tilts, pair(image_tilt))


def assemble(
    prescription: Prescription, lean: float, tolerances: Tolerances, rng: np.random.Generator
) -> AssembledPath:
    """A path as a workshop would deliver it.

    Its axis leans by ``lean`` (rad) from the twin's z towards +x, but for its error. The assembler then slides the
    whole path sideways until the middle of its image sees the specimen's middle, which leaves the pointing error.
    """
    errors = draw_path_errors(prescription, tolerances, rng)
    path = place(prescription, errors)
    axis_error = np.radians(tolerances.axis_deg) * rng.standard_normal(2)
    focus_error = tolerances.focus_mm * rng.standard_normal()
    pointing_error = tolerances.pointing_mm * rng.standard_normal(2)

    turn = (Rotation.from_euler("y", lean) * Rotation.from_rotvec([*axis_error, 0.0])).as_matrix()
    pose = np.eye(4)
    pose[:3, :3] = turn
    pose[:3, 3] = turn[:, 2] * focus_error
    origin, direction = (turn @ v for v in _central_ray(path))
    origin = origin + pose[:3, 3]
    seen = origin - direction * origin[2] / direction[2]
    pose[:2, 3] += pointing_error - seen[:2]
    return AssembledPath(path, errors, pose)


def _central_ray(path: PlacedPath) -> tuple[np.ndarray, np.ndarray]:
    """Point and direction of the ray through the middles of image and stop, where it leaves the path."""
    start = aim_exactly(
        path, image_point(path.image, Double(0), Double(0)), Double(0), Double(0), DESIGN_WAVELENGTH_UM, False
    )
    rays, _ = trace(path, start, DESIGN_WAVELENGTH_UM, outwards=False)
    values = np.array([np.array(value)[0] for value in rays])
    return values[:3], values[3:]
