"""Where in a picture light can be, and where shapes meet: one look along the middle of each pixel.

Light paths are spent only on pixels that a projector's light may reach, and many of them only where a pixel's blur may
hold more than one shape.
"""

from collections.abc import Callable
from dataclasses import dataclass
from math import ceil

import cv2
import numpy as np

from ..renderer import dr, mi
from .lens_projector import LensProjector

CameraRay = Callable[[mi.UInt32, mi.Point2f, mi.Point2f], tuple[mi.Ray3f, mi.Float]]

MARGIN = 1.25  # on the size of a blur that is known from single rays
STRIDE = 8  # of the pixels in rows and columns whose blur is looked at


@dataclass(frozen=True, eq=False)
class Survey:
    """Pixels, counted along rows.

    Parameters
    ----------
    lit : (n,) UInt32
        What they see may lie in a projector's light, in the shadow or not.
    edges : (m,) UInt32
        Those of them that may see more than one shape, as far as both begin within the picture.
    """

    lit: mi.UInt32
    edges: mi.UInt32


def survey(scene: mi.Scene, size: tuple[int, int], camera_ray: CameraRay) -> Survey:
    """Look along the middle of each pixel.

    Parameters
    ----------
    scene : mi.Scene
        With another emitter than projectors no pixel counts as dark.
    size : (cols, rows)
        Of the picture.
    camera_ray : callable
        Ray and weight for numbers of pixels and samples of their area and of the pupil.
    """
    cols, rows = size
    middle = mi.Point2f(0.5)
    pixel = dr.arange(mi.UInt32, cols * rows)
    ray, _ = camera_ray(pixel, middle, middle)
    si = scene.ray_intersect(ray, mi.RayFlags.Minimal, coherent=True)
    lit = dr.full(mi.Bool, False, cols * rows)
    for emitter in scene.emitters():
        lit |= (si.is_valid() & _in_reach(emitter, si.p)) if isinstance(emitter, LensProjector) else True
    shape = dr.reinterpret_array(mi.UInt32, si.shape)
    dr.eval(lit, shape)

    reach = 1 + ceil(MARGIN * _blur(scene, size, camera_ray))
    window = np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
    near_light = cv2.dilate(lit.numpy().reshape(rows, cols).astype(np.uint8), window) > 0
    shapes = shape.numpy().reshape(rows, cols).astype(np.float32)
    meet = cv2.dilate(shapes, window) != cv2.erode(shapes, window)
    return Survey(*(mi.UInt32(np.flatnonzero(where).astype(np.uint32)) for where in (near_light, near_light & meet)))


def _in_reach(projector: LensProjector, p: mi.Point3f) -> mi.Bool:
    """Whether light of the patterns may come to ``p`` through some part of the pupil."""
    _, column, row, _ = projector.aim(p, mi.Point2f(0.5))
    _, rim_column, rim_row, _ = projector.aim(p, mi.Point2f(1, 0.5))
    across, down = projector.pitch
    radius = MARGIN * dr.hypot((rim_column - column) * across, (rim_row - row) * down)
    return projector.reaches(column, row, 1 + radius / across, 1 + radius / down)


def _blur(scene: mi.Scene, size: tuple[int, int], camera_ray: CameraRay) -> float:
    """Radius in pixels of the largest disc that a pupil makes of a point in the picture."""
    cols, rows = size
    u, v = np.meshgrid(np.arange(0, cols - 1, STRIDE), np.arange(0, rows, STRIDE))
    pixel = mi.UInt32((v * cols + u).ravel().astype(np.uint32))
    middle = mi.Point2f(0.5)
    ray, _ = camera_ray(pixel, middle, middle)
    si = scene.ray_intersect(ray, mi.RayFlags.Minimal, coherent=True)
    rim, beside = (_beside(camera_ray(*more)[0], si.p, ray.d) for more in (
        (pixel, middle, mi.Point2f(1, 0.5)),
        (pixel + 1, middle, middle),
    ))  # fmt: skip
    ratio = dr.select(si.is_valid(), rim / beside, 0.0)
    return float(dr.max(ratio)[0])


def _beside(ray: mi.Ray3f, p: mi.Point3f, axis: mi.Vector3f) -> mi.Float:
    """Distance of a ray from ``p`` in the plane through it that is perpendicular to ``axis``."""
    t = dr.dot(p - ray.o, axis) / dr.dot(ray.d, axis)
    return dr.norm(ray(t) - p)
