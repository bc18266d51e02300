"""Smoothing of faint light along surfaces, but not across their edges."""

from collections.abc import Sequence

from ..renderer import dr, mi

BEND = 0.05  # rad between the normals of two pixels of one smooth surface, standard deviation
STEP = 0.1  # rad between a surface and the line to another pixel's point on it


def smoothed(
    channels: Sequence[mi.Float], si: mi.SurfaceInteraction3f, size: tuple[int, int], radius: int
) -> list[mi.Float]:
    """Pictures averaged under a Gaussian along rows and then along columns, with weights for what is alike.

    A pixel counts by how much its normal and the line to it differ from those of the same plane, and not at all if it
    has another reflectance function: a joint bilateral filter.

    Parameters
    ----------
    channels : sequence of mi.Float
        The pictures, (rows * cols,) each.
    si : mi.SurfaceInteraction3f
        What the pixels see, evaluated, (rows * cols,).
    size : (cols, rows)
        Of the pictures.
    radius : int
        Of the Gaussian in pixels: it is cut off at one and a half standard deviations.
    """
    for stride, count in ((1, size[0]), (size[0], size[1])):
        channels = _along(list(channels), si, size[0], stride, count, radius)
        dr.eval(channels)
    return list(channels)


@dr.syntax
def _along(channels, si, cols, stride, count, radius):
    """One axis: pixels ``stride`` apart, ``count`` of them in a line."""
    pixel = dr.arange(mi.Int32, dr.width(channels[0]))
    position = pixel // stride % count
    seen, surface = si.is_valid(), dr.reinterpret_array(mi.UInt32, si.bsdf())
    points, normals = si.p, si.sh_frame.n
    p, n = mi.Point3f(points), mi.Normal3f(normals)
    weights = mi.Float(0)
    totals = [mi.Float(0) for _ in channels]
    k, end = mi.Int32(-radius), dr.opaque(mi.Int32, radius)
    while k <= end:
        there = mi.UInt32(pixel + (dr.clip(position + k, 0, count - 1) - position) * stride)
        within = (position + k >= 0) & (position + k < count)
        alike = within & seen & dr.gather(mi.Bool, seen, there) & (dr.gather(mi.UInt32, surface, there) == surface)
        normal = dr.gather(mi.Normal3f, normals, there)
        to = mi.Vector3f(dr.gather(mi.Point3f, points, there) - p)
        rise = (dr.square(dr.dot(n, to)) + dr.square(dr.dot(normal, to))) / dr.maximum(dr.squared_norm(to), 1e-30)
        apart = dr.squared_norm(normal - n) / BEND**2 + rise / STEP**2 + dr.square(1.5 * mi.Float(k) / radius)
        weight = dr.select(k == 0, 1.0, dr.select(alike, dr.exp(-0.5 * apart), 0.0))
        weights += weight
        for c in range(len(totals)):
            totals[c] += weight * dr.gather(mi.Float, channels[c], there)
        k += 1
    return [total / weights for total in totals]
