"""Sequential ray tracing through a placed path, in either direction.

Everything works on Dr.Jit arrays of any precision: single inside the renderer, double for analysis. Single precision
is enough because nothing is ever computed as a small difference of large numbers: a ray goes to the plane through a
surface's vertex first, and from there along the small sag; z is kept relative to that vertex.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cache, partial
from typing import Any, NamedTuple

from ..in_memory import in_memory
from ..renderer import dr, mi
from .glasses import AIR, index
from .placed import PlacedImage, PlacedPath

Double: Any = dr.float64_array_t(mi.Float)  # the arrays for analysis


class Rays(NamedTuple):
    """Rays in path coordinates. All fields are Dr.Jit arrays of one type; directions are unit vectors."""

    x: Any
    y: Any
    z: Any
    l: Any  # noqa: E741  l, m, n are the names of direction cosines in optics
    m: Any
    n: Any


@dataclass(frozen=True)
class Crossing:
    """A surface as rays meet it on their way.

    What differs from instrument to instrument are Dr.Jit arrays of one element, see ``in_memory``. Rims and glasses are
    the prescription's.
    """

    x: Any  # of the vertex, path coordinates
    y: Any
    z: Any
    gap: Any  # from the z of the vertex before, or from 0
    lean_x: Any  # of the axis
    lean_y: Any
    upright: Any
    leans: bool
    curvature: float
    semi_diameter: float
    rim_width: float | None
    glasses: tuple[str, str]  # before and behind, as the rays go


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
    """``follow`` the ``way`` through a path; see both."""
    return follow(way(path, type(rays.x), outwards, surfaces, rims), rays, wavelength_um, outwards)


def way(
    path: PlacedPath,
    kind: Any,
    outwards: bool,
    surfaces: Iterable[int] | None = None,
    rims: Mapping[int, float] | None = None,
) -> tuple[Crossing, ...]:
    """The surfaces that rays meet, one after the other.

    Parameters
    ----------
    path : PlacedPath
    kind : type
        Of the rays' arrays.
    outwards : bool
        From the specimen towards the image, or back.
    surfaces : iterable of int, optional
        Which ones, from the specimen outwards whatever the direction; by default all.
    rims : mapping of int to float, optional
        Surfaces whose rim is looked at, and over which width in mm the light falls to nothing there; 0 is a sharp rim.
        By default no rim is.
    """
    number = cache(partial(in_memory, kind))  # the surfaces of an element share their axis
    numbers = list(range(len(path.surfaces)) if surfaces is None else surfaces)
    crossings, reference = [], 0.0
    for k in numbers if outwards else reversed(numbers):
        surface = path.surfaces[k]
        x, y, z = surface.vertex
        lean_x, lean_y, upright = surface.axis
        before, behind = surface.glass_before, surface.glass_behind
        crossings.append(
            Crossing(
                *map(number, (x, y, z, z - reference, lean_x, lean_y, upright)),
                leans=bool(lean_x or lean_y),
                curvature=surface.curvature,
                semi_diameter=surface.semi_diameter,
                rim_width=rims.get(k) if rims is not None else None,
                glasses=(before, behind) if outwards else (behind, before),
            )
        )
        reference = z
    return tuple(crossings)


def follow(way: Iterable[Crossing], rays: Rays, wavelength_um: Any, outwards: bool) -> tuple[Rays, Any]:
    """Refract ``rays`` at one surface after the other.

    Parameters
    ----------
    way : iterable of Crossing
        In the order in which they are met, all ``outwards`` or back.
    rays : Rays
        Anywhere before the first surface that they meet.
    wavelength_um : float or Dr.Jit array
    outwards : bool
        From the specimen towards the image, or back.

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
    passed, possible = type(x)(1), True
    indices: dict[str, Any] = {AIR: 1.0}
    reference = 0.0  # the plane that z counts from
    for at in way:
        for glass in at.glasses:
            if glass not in indices:
                indices[glass] = index(glass, wavelength_um)
        c = at.curvature
        # To the plane through the vertex; from here on relative to the vertex.
        t = (at.gap - z) / n
        x, y, reference = dr.fma(t, l, x - at.x), dr.fma(t, m, y - at.y), at.z
        # Points w of the surface obey c w² = 2 axis·w. Its root along the ray stays finite for planes.
        b = at.upright * n - c * dr.fma(x, l, y * m)
        f = c * dr.fma(x, x, y * y)
        if at.leans:
            b += at.lean_x * l + at.lean_y * m
            f -= 2 * (at.lean_x * x + at.lean_y * y)
        square = dr.fma(b, b, -c * f)
        cos_in = sign * dr.sqrt(dr.maximum(square, 0))
        t = f / (b + cos_in)
        x, y, z = dr.fma(t, l, x), dr.fma(t, m, y), t * n
        if c:
            possible &= square > 0
        if at.rim_width is not None:
            passed *= _inside(dr.sqrt(dr.fma(x, x, y * y)), at.semi_diameter, at.rim_width)
        if at.glasses[0] != at.glasses[1]:
            eta = indices[at.glasses[0]] / indices[at.glasses[1]]
            rest = dr.fma(-eta * eta, 1 - square, 1)
            possible &= rest > 0
            bend = sign * dr.sqrt(dr.maximum(rest, 0)) - eta * cos_in
            l = dr.fma(eta, l, bend * (at.lean_x - c * x))  # noqa: E741  as in Rays
            m = dr.fma(eta, m, bend * (at.lean_y - c * y))
            n = sign * dr.sqrt(1 - dr.fma(l, l, m * m))
        x, y = x + at.x, y + at.y
    return Rays(x, y, z + reference, l, m, n), dr.select(possible, passed, 0)


def image_in_memory(image: PlacedImage, kind: Any) -> PlacedImage:
    """An image for arrays of one ``kind``, see ``in_memory``."""
    return PlacedImage(
        *(
            (in_memory(kind, x), in_memory(kind, y), in_memory(kind, z))
            for x, y, z in (image.centre, image.along_x, image.along_y, image.normal)
        )
    )


def land(image: PlacedImage, rays: Rays) -> tuple[Any, Any]:
    """Where ``rays``, behind the last surface, meet the image: (x, y) in its plane, from its centre."""
    image = image_in_memory(image, type(rays.x))
    centre, normal = image.centre, image.normal
    x, y, z = rays.x - centre[0], rays.y - centre[1], rays.z - centre[2]
    across = normal[0] * rays.l + normal[1] * rays.m + normal[2] * rays.n
    t = -(normal[0] * x + normal[1] * y + normal[2] * z) / across
    x, y, z = dr.fma(t, rays.l, x), dr.fma(t, rays.m, y), dr.fma(t, rays.n, z)
    return _dot(image.along_x, x, y, z), _dot(image.along_y, x, y, z)


def image_point(image: PlacedImage, x: Any, y: Any) -> tuple[Any, Any, Any]:
    """Path coordinates of the image's point (x, y)."""
    image = image_in_memory(image, type(x))
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


def _dot(axis: tuple[Any, Any, Any], x: Any, y: Any, z: Any) -> Any:
    return dr.fma(axis[0], x, dr.fma(axis[1], y, axis[2] * z))
