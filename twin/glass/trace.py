"""Sequential ray tracing through a placed path, in either direction.

Everything works on Dr.Jit arrays of any precision: single inside the renderer, double for analysis. Single precision
is enough because nothing is ever computed as a small difference of large numbers: a ray goes to the plane through a
surface's vertex first, and from there along the small sag; z is kept relative to that vertex.
"""

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

from ..renderer import dr, mi
from .glasses import AIR, index
from .placed import PlacedPath

Double: Any = dr.float64_array_t(mi.Float)  # the arrays for analysis


class Rays(NamedTuple):
    """Rays in path coordinates. All fields are Dr.Jit arrays of one type; directions are unit vectors."""

    x: Any
    y: Any
    z: Any
    l: Any  # noqa: E741  l, m, n are the names of direction cosines in optics
    m: Any
    n: Any


def rays_through(x: Any, y: Any, z: Any, to_x: Any, to_y: Any, to_z: float, outwards: bool) -> Rays:
    """Rays from (x, y, z) that head for (to_x, to_y, to_z) or away from it: n > 0 if ``outwards``, else n < 0.

    A pupil may lie on either side of the point.
    """
    slope_x, slope_y = (to_x - x) / (to_z - z), (to_y - y) / (to_z - z)
    n = dr.rsqrt(dr.fma(slope_x, slope_x, dr.fma(slope_y, slope_y, 1)))
    n = n if outwards else -n
    return Rays(x, y, z, slope_x * n, slope_y * n, n)


def trace(
    path: PlacedPath,
    rays: Rays,
    wavelength_um: Any,
    outwards: bool,
    surfaces: Iterable[int] | None = None,
    rims: Mapping[int, float] | None = None,
) -> tuple[Rays, Any]:
    """Refract ``rays`` at one surface after the other.

    Parameters
    ----------
    path : PlacedPath
    rays : Rays
        Anywhere before the first surface that they meet.
    wavelength_um : float or Dr.Jit array
    outwards : bool
        From the specimen towards the image, or back.
    surfaces : iterable of int, optional
        Which ones, from the specimen outwards whatever the direction; by default all.
    rims : mapping of int to float, optional
        Surfaces whose rim is looked at, and over which width in mm the light falls to nothing there; 0 is a sharp rim.
        By default no rim is.

    Returns
    -------
    rays : Rays
        On the last surface, behind its refraction.
    passed : Dr.Jit array
        Share of each ray's light that has passed, 0 to 1. Rays that miss a surface or are reflected totally have 0;
        their coordinates mean nothing.
    """
    x, y, z, l, m, n = rays  # noqa: E741  as in Rays
    sign = 1.0 if outwards else -1.0
    indices = {name: index(name, wavelength_um) for pair in path.prescription.glasses for name in pair}
    passed, possible = type(x)(1), True
    reference = 0.0  # the plane that z counts from
    numbers = list(range(len(path.surfaces)) if surfaces is None else surfaces)
    for k in numbers if outwards else reversed(numbers):
        surface = path.surfaces[k]
        (at_x, at_y, at_z), (lean_x, lean_y, upright) = surface.vertex, surface.axis
        c = surface.curvature
        # To the plane through the vertex; from here on relative to the vertex.
        t = (at_z - reference - z) / n
        x, y, reference = dr.fma(t, l, x - at_x), dr.fma(t, m, y - at_y), at_z
        # Points w of the surface obey c w² = 2 axis·w. Its root along the ray stays finite for planes.
        b = upright * n - c * dr.fma(x, l, y * m)
        f = c * dr.fma(x, x, y * y)
        if lean_x or lean_y:
            b += lean_x * l + lean_y * m
            f -= 2 * (lean_x * x + lean_y * y)
        square = dr.fma(b, b, -c * f)
        cos_in = sign * dr.sqrt(dr.maximum(square, 0))
        t = f / (b + cos_in)
        x, y, z = dr.fma(t, l, x), dr.fma(t, m, y), t * n
        if c:
            possible &= square > 0
        if rims is not None and k in rims:
            passed *= _inside(dr.sqrt(dr.fma(x, x, y * y)), surface.semi_diameter, rims[k])
        if surface.glass_before != surface.glass_behind:
            pair = indices[surface.glass_before], indices[surface.glass_behind]
            eta = pair[0] / pair[1] if outwards else pair[1] / pair[0]
            rest = dr.fma(-eta * eta, 1 - square, 1)
            possible &= rest > 0
            bend = sign * dr.sqrt(dr.maximum(rest, 0)) - eta * cos_in
            l = dr.fma(eta, l, bend * (lean_x - c * x))  # noqa: E741  as in Rays
            m = dr.fma(eta, m, bend * (lean_y - c * y))
            n = sign * dr.sqrt(1 - dr.fma(l, l, m * m))
        x, y = x + at_x, y + at_y
    return Rays(x, y, z + reference, l, m, n), dr.select(possible, passed, 0)


def land(path: PlacedPath, rays: Rays) -> tuple[Any, Any]:
    """Where ``rays``, behind the last surface, meet the image: (x, y) in its plane, from its centre."""
    image = path.image
    centre, normal = image.centre, image.normal
    x, y, z = rays.x - centre[0], rays.y - centre[1], rays.z - centre[2]
    across = normal[0] * rays.l + normal[1] * rays.m + normal[2] * rays.n
    t = -(normal[0] * x + normal[1] * y + normal[2] * z) / across
    x, y, z = dr.fma(t, rays.l, x), dr.fma(t, rays.m, y), dr.fma(t, rays.n, z)
    return _dot(image.along_x, x, y, z), _dot(image.along_y, x, y, z)


def image_point(path: PlacedPath, x: Any, y: Any) -> tuple[Any, Any, Any]:
    """Path coordinates of the image's point (x, y)."""
    image = path.image
    px, py, pz = (
        dr.fma(x, along_x, dr.fma(y, along_y, centre))
        for centre, along_x, along_y in zip(image.centre, image.along_x, image.along_y, strict=True)
    )
    return px, py, pz


def at_height(rays: Rays, z: float) -> tuple[Any, Any]:
    """(x, y) of ``rays``, taken for straight lines, in the plane at ``z``."""
    t = (z - rays.z) / rays.n
    return dr.fma(t, rays.l, rays.x), dr.fma(t, rays.m, rays.y)


def sharp_rims(path: PlacedPath) -> dict[int, float]:
    """All rims of lenses, sharp, for ``trace``. The stop is left out: rays are aimed at points of it."""
    return {k: 0.0 for k in range(len(path.surfaces)) if k != path.prescription.stop}


def lens_surfaces(path: PlacedPath) -> tuple[int, ...]:
    """All surfaces but the stop, which bends no ray."""
    return tuple(k for k, s in enumerate(path.surfaces) if s.glass_before != AIR or s.glass_behind != AIR)


def _inside(radius: Any, semi_diameter: float, width: float) -> Any:
    """1 inside of ``semi_diameter``, 0 outside, linear over ``width`` around it."""
    if width == 0:
        return dr.select(radius < semi_diameter, type(radius)(1), type(radius)(0))
    return dr.clip(0.5 + (semi_diameter - radius) / width, 0, 1)


def _dot(axis: tuple[float, float, float], x: Any, y: Any, z: Any) -> Any:
    return dr.fma(axis[0], x, dr.fma(axis[1], y, axis[2] * z))
