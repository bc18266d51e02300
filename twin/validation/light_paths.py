"""Single rays through both lenses of one instrument, in double precision: what a picture is the mean of.

Everything is in the twin's frame. A ray is named by its pixel or point, by a place in the stop as the unit disk, and by
its wavelength; the lenses are those that the renderer traces, glass as it was built or ideal ones.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from greenough.instrument.packets import packed
from greenough.instrument.rigfile import RigFile

from ..glass.as_built import AssembledPath
from ..glass.paraxial import paraxial
from ..glass.sampling import sample_path
from ..glass.spectrum import Spectrum
from ..glass.trace import Double
from ..node_design import disk, tent
from ..renderer import dr
from ..scene import assembled, axis_frame
from ..settings import OpticsSettings, TwinSettings

PUPIL_NODES = 16  # as the plugins have it: how softly a rim cuts

STAGGER = 0.25
"""Columns by which the middle of the array lies beside that of its even rows: odd ones stand half a column further."""


@dataclass(frozen=True, eq=False)
class Nodes:
    """The light paths that the renderer takes the mean of, in every pixel the same.

    Parameters
    ----------
    within : (nodes, 2)
        Places in the pixel, columns and rows from its middle.
    camera_stop, projector_stop : (nodes, 2)
        Points of the unit disk.
    wavelength_um : (nodes,)
    """

    within: np.ndarray
    camera_stop: np.ndarray
    projector_stop: np.ndarray
    wavelength_um: np.ndarray

    def __len__(self) -> int:
        return len(self.wavelength_um)


def renderer_nodes(table: np.ndarray, settings: TwinSettings) -> Nodes:
    """The nodes of a ``table`` (nodes, 6) of the unit cube, as the plugin ``fringe`` uses it."""
    count = len(table)
    shares = count // 2  # of the spectrum: a node and its mirror image have one
    bits = int(np.log2(shares))
    reversed_index = np.array([int(f"{k % shares:0{bits}b}"[::-1], 2) for k in range(count)])
    bandwidth = settings.light.bandwidth_um if settings.optics.glass else 0.0
    spectrum = Spectrum(settings.optics.wavelength_um, bandwidth)
    middles = Double(packed((reversed_index + 0.5) / shares))
    wavelength = np.array(spectrum.wavelength_um(middles, spectrum.parting(shares)))
    within = tent(table[:, :2]) if settings.optics.camera_diffraction else table[:, :2] - 0.5
    open_stop = float(settings.optics.finite_aperture)
    return Nodes(
        within, open_stop * disk(table[:, 2:4]), open_stop * disk(table[:, 4:]), np.broadcast_to(wavelength, count)
    )


@dataclass(frozen=True, eq=False)
class LightPaths:
    """Both lenses.

    Parameters
    ----------
    ray : callable
        (pixels (n, 2), stop (n, 2), wavelength (n,)) to origin (n, 3), direction (n, 3), weight (n,) of the camera.
    image : callable
        (points (n, 3), stop, wavelength) to pixels (n, 2) where the point is imaged through that point of the stop.
    column : callable
        (points (n, 3), stop, wavelength) to column and row (n, 2) on the mirrors, the direction (n, 3) that the light
        comes from, and its weight (n,).
    """

    ray: Callable[[np.ndarray, np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray, np.ndarray]]
    image: Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]
    column: Callable[[np.ndarray, np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray, np.ndarray]]


def light_paths(rig_file: RigFile, settings: TwinSettings) -> LightPaths:
    """The lenses of one instrument as its seed draws them."""
    optics = settings.optics
    scale = optics.pupil_distance_mm / optics.camera_focal_px  # mm per px
    rows, cols = rig_file.camera.shape
    centre = np.array([(cols - 1) / 2, (rows - 1) / 2])
    mirror_rows, mirror_cols = rig_file.projector.shape
    pitch = 1e-3 * np.array([optics.column_pitch_um, optics.row_pitch_um])
    middle = np.array([(mirror_cols - 1) / 2 + STAGGER, (mirror_rows - 1) / 2])
    lean = np.radians(optics.convergence_deg) / 2
    if optics.glass:
        camera = assembled("camera", float(-lean), settings.assembly, settings.seed)
        projector = assembled("projector", float(lean), settings.assembly, settings.seed)
        outwards, inwards = _glass_outwards(camera), _glass_inwards(camera)
        to_mirrors = _glass_outwards(projector)
    else:
        outwards, inwards = (
            make(optics, axis_frame(-lean, optics.pupil_distance_mm)) for make in (_ideal_outwards, _ideal_inwards)
        )
        to_mirrors = _ideal_outwards(optics, axis_frame(lean, optics.pupil_distance_mm))

    def ray(pixels: np.ndarray, stop: np.ndarray, um: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return inwards((pixels - centre) * scale, stop, um)

    def image(points: np.ndarray, stop: np.ndarray, um: np.ndarray) -> np.ndarray:
        return outwards(points, stop, um)[0] / scale + centre

    def column(points: np.ndarray, stop: np.ndarray, um: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        at, direction, weight = to_mirrors(points, stop, um)
        return middle + at / pitch, direction, weight

    return LightPaths(ray, image, column)


def _moved(motion: np.ndarray, vectors: np.ndarray, shift: float) -> np.ndarray:
    return vectors @ motion[:3, :3].T + shift * motion[:3, 3]


def _doubles(*columns: np.ndarray) -> list[Any]:
    return [Double(packed(column.astype(float, copy=False))) for column in columns]


def _array(*columns: Any) -> np.ndarray:
    return np.stack([np.array(column) for column in columns], axis=-1)


def _glass_outwards(built: AssembledPath) -> Callable:
    """(points, stop, wavelength) to mm along columns and rows of what is seen, direction to the pupil, weight."""
    sampled, summary = sample_path(built.path, Double, True, PUPIL_NODES), paraxial(built.path.prescription)
    path_from_twin = np.linalg.inv(built.twin_from_path)

    def outwards(points: np.ndarray, stop: np.ndarray, um: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        in_path = _moved(path_from_twin, points, 1.0)
        x, y, z, stop_x, stop_y, wavelength = _doubles(*in_path.T, *stop.T, um)
        pupil, at, weight = sampled.from_specimen(x, y, z, stop_x, stop_y, wavelength)
        dr.eval(pupil, at, weight)  # together: one by one each would be traced anew
        heads_for = np.column_stack([_array(*pupil), np.full(len(points), summary.entrance.z)])
        towards = heads_for - in_path
        towards /= np.linalg.norm(towards, axis=1, keepdims=True)
        scale = summary.magnification * np.array([1.0, -1.0])
        return _array(*at) / scale, _moved(built.twin_from_path, towards, 0.0), np.array(weight)

    return outwards


def _glass_inwards(built: AssembledPath) -> Callable:
    """(mm along columns and rows, stop, wavelength) to origin, direction and weight of the ray to the specimen."""
    sampled, summary = sample_path(built.path, Double, False, PUPIL_NODES), paraxial(built.path.prescription)

    def inwards(at: np.ndarray, stop: np.ndarray, um: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        scale = summary.magnification * np.array([1.0, -1.0])
        x, y, stop_x, stop_y, wavelength = _doubles(*(at * scale).T, *stop.T, um)
        rays, weight = sampled.from_image(x, y, stop_x, stop_y, wavelength)
        dr.eval(rays, weight)
        origin, direction = _array(*rays[:3]), _array(*rays[3:])
        return _moved(built.twin_from_path, origin, 1.0), _moved(built.twin_from_path, direction, 0.0), np.array(weight)

    return inwards


def _ideal_outwards(optics: OpticsSettings, twin_from_pupil: np.ndarray) -> Callable:
    """As `_glass_outwards`, behind an ideal lens that stands where it should."""
    distance, pupil_from_twin = optics.pupil_distance_mm, np.linalg.inv(twin_from_pupil)

    def outwards(points: np.ndarray, stop: np.ndarray, um: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        local, pupil = _moved(pupil_from_twin, points, 1.0), stop * (optics.na * distance)
        reach = distance / local[:, 2:]
        towards = np.column_stack([pupil, np.zeros(len(pupil))]) - local
        length = np.linalg.norm(towards, axis=1)
        at = -(pupil + (local[:, :2] - pupil) * reach)
        weight = reach[:, 0] ** 2 * length / local[:, 2]
        return at, _moved(twin_from_pupil, towards / length[:, None], 0.0), weight

    return outwards


def _ideal_inwards(optics: OpticsSettings, twin_from_pupil: np.ndarray) -> Callable:
    """As `_glass_inwards`, behind an ideal lens that stands where it should."""
    distance = optics.pupil_distance_mm

    def inwards(at: np.ndarray, stop: np.ndarray, um: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        pupil = np.column_stack([stop * (optics.na * distance), np.zeros(len(stop))])
        direction = np.column_stack([-at, np.full(len(at), distance)]) - pupil
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        return _moved(twin_from_pupil, pupil, 1.0), _moved(twin_from_pupil, direction, 0.0), np.ones(len(at))

    return inwards
