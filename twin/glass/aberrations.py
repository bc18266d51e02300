"""What a path does to its image, seen on the specimen's side: spots, focus, distortion, colour, vignetting.

Each point of the image has a pencil: the straight lines on the specimen's side of all rays from that point through the
stop. Everything follows from these lines, for the camera as for the projector, whose light runs along them.
"""

from dataclasses import dataclass

import numpy as np

from greenough.instrument.packets import packed

from .aiming import aim_exactly
from .paraxial import DESIGN_WAVELENGTH_UM, paraxial
from .placed import PlacedPath
from .trace import Double, at_height, image_point, sharp_rims, trace

THIN = 0.01  # of the stop's radius: pencils that have no spherical aberration


@dataclass(frozen=True, eq=False)
class Pencils:
    """Lines on the specimen's side, in path coordinates: (x, y) = at_zero + z slope."""

    at_zero: np.ndarray  # (points, rays, 2)
    slope: np.ndarray  # (points, rays, 2)
    passed: np.ndarray  # (points, rays), 1 where no rim cuts the ray off, else 0

    def crossing(self, z: float | np.ndarray) -> np.ndarray:
        """(x, y) in the planes at z, a number or (points,); the result is (points, rays, 2)."""
        return self.at_zero + np.reshape(z, (-1, 1, 1)) * self.slope


def stop_points(rings: int) -> np.ndarray:
    """Points of the unit disk that stand for equal areas, on ``rings`` rings and in the middle, (m, 2)."""
    points = [np.zeros((1, 2))]
    for ring in range(1, rings + 1):
        angle = 2 * np.pi * (np.arange(6 * ring) + 0.5 * (ring % 2)) / (6 * ring)
        # The ring's middle line by area: inside of it lie 3 ring (ring - 1) + 1 points and half its own.
        radius = np.sqrt((3 * ring**2 + 1) / (3 * rings * (rings + 1) + 1))
        points.append(radius * np.stack([np.cos(angle), np.sin(angle)], axis=1))
    return np.concatenate(points)


def image_points(path: PlacedPath, field: np.ndarray) -> np.ndarray:
    """Points of the image, mm from its centre, that first-order optics gives for ``field``, (n, 2) on the specimen."""
    return paraxial(path.prescription).magnification * np.asarray(field, float)


def pencils(
    path: PlacedPath, points: np.ndarray, disk: np.ndarray, wavelength_um: float = DESIGN_WAVELENGTH_UM
) -> Pencils:
    """Pencils of image ``points``, (n, 2) mm from its centre, through points ``disk`` of the stop, the unit disk.

    ``disk`` is (m, 2), or (n, m, 2) with others for each point. Rays are traced in double precision.
    """
    shape = len(points), disk.shape[-2]
    x, y = (Double(packed(np.repeat(points[:, axis], shape[1]))) for axis in (0, 1))
    stop = path.prescription.stop_radius * np.broadcast_to(disk, (*shape, 2)).reshape(-1, 2)
    stop_x, stop_y = (Double(packed(stop[:, axis])) for axis in (0, 1))
    start = aim_exactly(path, image_point(path.image, x, y), stop_x, stop_y, wavelength_um, False)
    rays, passed = trace(path, start, wavelength_um, outwards=False, rims=sharp_rims(path))
    at_zero = np.stack([np.array(value) for value in at_height(rays, 0.0)], axis=-1)
    slope = np.stack([np.array(rays.l / rays.n), np.array(rays.m / rays.n)], axis=-1)
    return Pencils(at_zero.reshape(*shape, 2), slope.reshape(*shape, 2), np.array(passed).reshape(shape))


def chief_rays(path: PlacedPath, points: np.ndarray, wavelength_um: float = DESIGN_WAVELENGTH_UM) -> Pencils:
    """The rays of image ``points`` through the middle of the stop, as pencils of one ray."""
    return pencils(path, points, np.zeros((1, 2)), wavelength_um)


def best_focus(bundle: Pencils) -> np.ndarray:
    """z where each pencil's RMS radius is least, (points,); rims are left out of account."""
    at_zero = bundle.at_zero - bundle.at_zero.mean(axis=1, keepdims=True)
    slope = bundle.slope - bundle.slope.mean(axis=1, keepdims=True)
    return -np.einsum("pri,pri->p", at_zero, slope) / np.einsum("pri,pri->p", slope, slope)


def rms_radius(bundle: Pencils, z: float | np.ndarray) -> np.ndarray:
    """RMS distance of each pencil's rays from their centroid in the planes at z, (points,); rims are left out."""
    spot = bundle.crossing(z)
    spot = spot - spot.mean(axis=1, keepdims=True)
    return np.sqrt(np.mean(np.sum(spot**2, axis=-1), axis=1))


def astigmatic_foci(path: PlacedPath, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """z of the tangential and of the sagittal focus, (n,) each, of thin pencils around the chief rays.

    ``points`` are (n, 2) on the image; tangential is the direction from its centre.
    """
    radius = np.linalg.norm(points, axis=1, keepdims=True)
    outward = np.divide(points, radius, out=np.tile([1.0, 0.0], (len(points), 1)), where=radius > 0)
    across = np.stack([-outward[:, 1], outward[:, 0]], axis=1)
    tangential, sagittal = (
        best_focus(pencils(path, points, THIN * np.stack([axis, -axis], axis=1))) for axis in (outward, across)
    )
    return tangential, sagittal


def distortion(path: PlacedPath, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where the chief rays of image ``points`` cross z = 0, (n, 2), and their distortion, (n,).

    Distortion is the image's distance from its centre against first-order optics, minus 1.
    """
    field = chief_rays(path, points).at_zero[:, 0]
    ideal = image_points(path, field)
    return field, np.linalg.norm(points, axis=1) / np.linalg.norm(ideal, axis=1) - 1


def lateral_colour(path: PlacedPath, points: np.ndarray, wavelengths_um: np.ndarray) -> np.ndarray:
    """By how much the specimen's image lies further out than at the design wavelength, in mm of the specimen.

    Returns (wavelengths, points): the chief rays' shift at z = 0 with its sign turned, along the field's radius.
    """
    design = chief_rays(path, points).at_zero[:, 0]
    outward = design / np.linalg.norm(design, axis=1, keepdims=True)
    shifts = [chief_rays(path, points, wavelength).at_zero[:, 0] - design for wavelength in wavelengths_um]
    return -np.einsum("wpi,pi->wp", np.array(shifts), outward)


def vignetting(path: PlacedPath, points: np.ndarray, rings: int = 30) -> np.ndarray:
    """Share of the stop that image ``points``, (n, 2), see past the rims, (n,)."""
    return pencils(path, points, stop_points(rings)).passed.mean(axis=1)
