"""Where in a picture light can be, and where shapes meet: one look along the middle of each pixel.

Light paths are spent only on pixels that a projector's light may reach, and many of them only where a pixel's blur may
hold more than one shape. A shape so small that the middle of no pixel meets it is not found.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from greenough.instrument.packets import packed

from ..renderer import dr, mi
from .lens_projector import LensProjector

CameraRay = Callable[[mi.UInt32, mi.Point2f, mi.Point2f], tuple[mi.Ray3f, mi.Float]]

MARGIN = 1.25  # on the size of a blur that is known from single rays
BLOCK = 4  # pixels along the side of a block whose rays are traced together


@dataclass(frozen=True, eq=False)
class Survey:
    """Numbers of pixels, counted along rows; none is in both. Pixels of a small block follow each other.

    Parameters
    ----------
    lit : (n,) UInt32
        What they see may lie in a projector's light, in the shadow or not.
    edges : (m,) UInt32
        The same, and they may see more than one shape, as far as both begin within the picture.
    """

    lit: mi.UInt32
    edges: mi.UInt32


def survey(
    scene: mi.Scene, size: tuple[int, int], camera_ray: CameraRay, wavelength_um: float, find_edges: bool
) -> Survey:
    """Look along the middle of each pixel.

    Parameters
    ----------
    scene : mi.Scene
        With another emitter than projectors no pixel counts as dark.
    size : (cols, rows)
        Of the picture. What its outermost pixels see may go on beyond it: they count as lit.
    camera_ray : callable
        Ray and weight for numbers of pixels and samples of their area and of the pupil.
    wavelength_um : float
        The middle of the projectors' light.
    find_edges : bool
        Otherwise all pixels count as ``lit``.
    """
    cols, rows = size
    middle = mi.Point2f(0.5)
    projectors = [emitter for emitter in scene.emitters() if isinstance(emitter, LensProjector)]
    blur, *spreads = _widths(scene, projectors, size, camera_ray, wavelength_um)
    pixel = dr.arange(mi.UInt32, cols * rows)
    si = scene.ray_intersect(camera_ray(pixel, middle, middle)[0], mi.RayFlags.Minimal, coherent=True)
    lit = dr.full(mi.Bool, len(projectors) < len(scene.emitters()), cols * rows)
    for projector, spread in zip(projectors, spreads, strict=True):
        _, column, row, _ = projector.aim(si.p, middle, wavelength_um)
        radius = mi.Float(packed(MARGIN * spread.ravel(), aligned=True))
        across, down = (1 + radius / pitch for pitch in projector.pitch)
        lit |= si.is_valid() & projector.reaches(column, row, across, down)
    shape = dr.reinterpret_array(mi.UInt32, si.shape)
    dr.eval(lit, shape)

    reach = 1 + np.ceil(MARGIN * blur)  # of a pixel, in pixels
    everywhere = _window(int(reach.max()))
    picture = lit.numpy().reshape(rows, cols).astype(np.uint8)
    near_light = cv2.dilate(picture, everywhere, borderType=cv2.BORDER_CONSTANT, borderValue=1) > 0
    meet = np.zeros((rows, cols), bool)
    if find_edges:
        shapes = shape.numpy().reshape(rows, cols).astype(np.float32)
        reach = cv2.dilate(reach, everywhere)  # the most blurred of what a pixel may see decides
        for each in np.unique(reach):
            window = _window(int(each))
            meet |= (reach == each) & (cv2.dilate(shapes, window) != cv2.erode(shapes, window))
    return Survey(*(_in_blocks(near_light & where) for where in (~meet, meet)))


def _widths(
    scene: mi.Scene, projectors: list[LensProjector], size: tuple[int, int], camera_ray: CameraRay, wavelength_um: float
) -> list[np.ndarray]:
    """Radii of the discs that the pupils make of a point of what each pixel sees, (rows, cols) float32 each.

    The first is in the picture, in pixels, the others are on the projectors' arrays, in scene units. They vary slowly:
    one pixel of a block is looked at, and the largest of the blocks around counts.
    """
    cols, rows = size
    middle, rim = mi.Point2f(0.5), mi.Point2f(1, 0.5)
    v, u = np.mgrid[:rows:BLOCK, :cols:BLOCK]
    pixel = mi.UInt32(packed((v * cols + u).ravel().astype(np.uint32), aligned=True))
    ray, _ = camera_ray(pixel, middle, middle)
    si = scene.ray_intersect(ray, mi.RayFlags.Minimal, coherent=True)
    aside, beside = (
        _beside(camera_ray(*more)[0], si.p, ray.d) for more in ((pixel, middle, rim), (pixel + 1, middle, middle))
    )
    radii = [aside / beside]
    for projector in projectors:
        (_, column, row, _), (_, rim_column, rim_row, _) = (
            projector.aim(si.p, sample, wavelength_um) for sample in (middle, rim)
        )
        across, down = projector.pitch
        radii.append(dr.hypot((rim_column - column) * across, (rim_row - row) * down))
    radii = [dr.select(si.is_valid(), radius, 0.0) for radius in radii]
    dr.eval(radii)
    largest = (cv2.dilate(radius.numpy().reshape(v.shape), _window(1)) for radius in radii)
    return [each.repeat(BLOCK, axis=0).repeat(BLOCK, axis=1)[:rows, :cols] for each in largest]


def _window(reach: int) -> np.ndarray:
    return np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)


def _in_blocks(where: np.ndarray) -> mi.UInt32:
    """Numbers of the pixels where ``where`` (rows, cols) is true, block by block."""
    order = blocks(where.shape)
    return mi.UInt32(packed(order[where.ravel()[order]], aligned=True))


@lru_cache(maxsize=4)
def blocks(shape: tuple[int, int]) -> np.ndarray:
    """Numbers of all pixels of a picture of ``shape``, (rows * cols,) uint32, block by block.

    Rays that are traced together meet the fewest triangles where their pixels lie in a square.
    """
    rows, cols = shape
    row, col = np.divmod(np.arange(rows * cols, dtype=np.uint32), np.uint32(cols))
    return np.lexsort((col, row, col // BLOCK, row // BLOCK)).astype(np.uint32)


def _beside(ray: mi.Ray3f, p: mi.Point3f, axis: mi.Vector3f) -> mi.Float:
    """Distance of a ray from ``p`` in the plane through it that is perpendicular to ``axis``."""
    t = dr.dot(p - ray.o, axis) / dr.dot(ray.d, axis)
    return dr.norm(ray(t) - p)
