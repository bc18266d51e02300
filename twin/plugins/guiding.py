"""Where the interreflections in each part of a picture come from: a map of the light around it, to draw paths from.

The light that reaches a surface by way of another one often comes from small bright spots, glints on balls for one.
Paths that leave a surface as its own reflectance proposes seldom meet them. So a picture is divided into tiles, and
from the surface point in the middle of each tile the light all around is looked at once. Paths of all pixels of a tile
go to points that are seen from that middle, the brighter the more often. Together with paths that the reflectance
proposes, each weighted by the balance heuristic (Veach, Guibas: "Optimally combining sampling techniques for Monte
Carlo rendering", SIGGRAPH 1995), the mean is right whatever the map holds.
"""

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

from ..renderer import dr, mi

TILE = 16  # pixels along a side
BINS = 32  # of equal solid angle along a side of a map
BLUR = 3  # bins: light is met a little beside where the middle sees it, too


@dataclass(frozen=True)
class Guide:
    """A map of the light over the hemisphere of each tile of a picture that is ``cols`` pixels wide."""

    cols: int
    origin: mi.Point3f  # (tiles,), just above the surface in the middle of a tile
    normal: mi.Normal3f  # (tiles,)
    rows: mi.Float  # (tiles, BINS), cumulative
    columns: mi.Float  # (tiles, BINS, BINS), cumulative in each row

    def tile(self, pixel: mi.UInt32) -> mi.UInt32:
        """The tile of a pixel, both counted along rows."""
        return pixel // self.cols // TILE * _tiles(self.cols) + pixel % self.cols // TILE

    def sample(self, tile: mi.UInt32, u: mi.Point2f, active: mi.Bool) -> mi.Ray3f:
        """A ray from the middle of ``tile`` to where light may come from."""
        row, y, some = _pick(self.rows, tile * BINS, u.y, active)
        column, x, _ = _pick(self.columns, (tile * BINS + row) * BINS, u.x, active)
        local = mi.warp.square_to_uniform_hemisphere(mi.Point2f(column + x, row + y) / BINS)
        origin, frame = self._middle(tile, active)
        ray = mi.Ray3f(origin, frame.to_world(local))
        ray.maxt = dr.select(some, ray.maxt, 0.0)
        return ray

    def density(self, tile: mi.UInt32, p: mi.Point3f, si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.Float:
        """How densely ``sample`` meets the surface at ``si``, per solid angle at ``p``.

        It is right only where the middle of the tile sees ``si``, see ``sees``.
        """
        origin, frame = self._middle(tile, active)
        local = frame.to_local(dr.normalize(mi.Vector3f(si.p - origin)))
        active = active & (local.z > 0)
        uv = mi.warp.uniform_hemisphere_to_square(local) * BINS
        x, y = dr.minimum(mi.UInt32(uv.x), BINS - 1), dr.minimum(mi.UInt32(uv.y), BINS - 1)
        share = _share(self.rows, tile * BINS, y, active) * _share(self.columns, (tile * BINS + y) * BINS, x, active)
        here = _solid_angle(p, si)
        density = share * (BINS**2 * dr.inv_two_pi) * _solid_angle(origin, si) / here
        return dr.select(active & (here > 0), density, 0.0)

    def sees(self, scene: mi.Scene, tile: mi.UInt32, si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.Bool:
        """Whether the middle of the tile sees ``si``."""
        origin, _ = self._middle(tile, active)
        return active & ~scene.ray_test(si.spawn_ray_to(origin), coherent=False, active=active)

    def _middle(self, tile: mi.UInt32, active: mi.Bool) -> tuple[mi.Point3f, mi.Frame3f]:
        normal = dr.gather(mi.Normal3f, self.normal, tile, active)
        return dr.gather(mi.Point3f, self.origin, tile, active), mi.Frame3f(normal)


def look_around(
    scene: mi.Scene,
    size: tuple[int, int],
    camera_ray: Callable[[mi.UInt32], mi.Ray3f],
    light: Callable[[mi.SurfaceInteraction3f, mi.Ray3f, mi.Bool], mi.Float],
) -> Guide:
    """The guide of a picture.

    Parameters
    ----------
    scene : mi.Scene
        What is in the picture.
    size : (cols, rows)
        Of the picture, in pixels.
    camera_ray : callable
        The ray through the middle of a pixel; pixels are counted along rows.
    light : callable
        Radiance that leaves a surface point against a ray, where a mask is true.
    """
    cols, rows = size
    tile = dr.arange(mi.UInt32, _tiles(cols) * _tiles(rows))
    x = dr.minimum(tile % _tiles(cols) * TILE + TILE // 2, cols - 1)
    y = dr.minimum(tile // _tiles(cols) * TILE + TILE // 2, rows - 1)
    ray = camera_ray(y * cols + x)
    middle = scene.ray_intersect(ray, mi.RayFlags.All, coherent=True)
    normal = mi.Normal3f(dr.mulsign(middle.n, -dr.dot(middle.n, ray.d)))
    origin = middle.spawn_ray(normal).o
    dr.eval(middle, normal, origin)
    maps = np.array(_maps(scene, middle, origin, mi.Frame3f(normal), light)).reshape(-1, BINS)
    maps = cv2.blur(np.nan_to_num(maps, posinf=0.0), (BLUR, BLUR), borderType=cv2.BORDER_CONSTANT)
    columns = np.cumsum(maps.reshape(-1, BINS, BINS), axis=2)
    sums = np.cumsum(columns[..., -1], axis=1)
    columns /= np.maximum(columns[..., -1:], np.finfo(np.float32).tiny)
    sums /= np.maximum(sums[:, -1:], np.finfo(np.float32).tiny)
    return Guide(cols, origin, normal, mi.Float(sums.ravel()), mi.Float(columns.ravel()))


@dr.syntax
def _maps(scene, middle, origin, frame, light):
    """Light that the middles of the tiles reflect to the camera, by where it comes from: (tiles, BINS, BINS)."""
    maps = dr.empty(mi.Float, dr.width(origin) * BINS**2)
    tile = dr.arange(mi.UInt32, dr.width(origin))
    bsdf, seen = middle.bsdf(), middle.is_valid()
    k = mi.UInt32(0)
    while k < BINS**2:
        centre = mi.Point2f(mi.Float(k % BINS) + 0.5, mi.Float(k // BINS) + 0.5) / BINS
        ray = mi.Ray3f(origin, frame.to_world(mi.warp.square_to_uniform_hemisphere(centre)))
        reflected = bsdf.eval(mi.BSDFContext(), middle, middle.to_local(ray.d), seen)[0]
        si = scene.ray_intersect(ray, mi.RayFlags.All, coherent=True, active=seen & (reflected > 0))
        met = si.is_valid()
        arriving = dr.if_stmt(args=(si, ray, met), cond=met, true_fn=light, false_fn=lambda si, ray, met: mi.Float(0))
        dr.scatter(maps, reflected * arriving, tile * BINS**2 + k)
        k += 1
    return maps


def _tiles(pixels: int) -> int:
    return -(-pixels // TILE)


def _solid_angle(p: mi.Point3f, si: mi.SurfaceInteraction3f) -> mi.Float:
    """Of a small area at ``si``, seen from ``p``, per area."""
    to = mi.Vector3f(si.p - p)
    squared = dr.squared_norm(to)
    return dr.abs(dr.dot(si.n, to)) / (squared * dr.sqrt(squared))


def _pick(cumulative: mi.Float, start: mi.UInt32, u: mi.Float, active: mi.Bool) -> tuple[mi.UInt32, mi.Float, mi.Bool]:
    """The bin among BINS from ``start`` that u falls in, where in it, and whether there is any light."""
    k = dr.binary_search(0, BINS - 1, lambda i: dr.gather(mi.Float, cumulative, start + mi.UInt32(i), active) <= u)
    k = mi.UInt32(k)
    low = dr.gather(mi.Float, cumulative, start + k - 1, active & (k > 0))
    high = dr.gather(mi.Float, cumulative, start + k, active)
    return k, dr.clip((u - low) / (high - low), 0.0, 1.0), high > low


def _share(cumulative: mi.Float, start: mi.UInt32, k: mi.UInt32, active: mi.Bool) -> mi.Float:
    """Probability of bin ``k`` among BINS from ``start``."""
    low = dr.gather(mi.Float, cumulative, start + k - 1, active & (k > 0))
    return dr.gather(mi.Float, cumulative, start + k, active) - low
