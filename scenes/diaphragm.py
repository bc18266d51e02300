"""The diaphragm of an earphone in three states: a thin film that the voltage pulls in or pushes out.

A film of 7.4 mm clamped in a flat flange outside 6.8 mm. Inside, it is deflected like a clamped plate; a concentric
groove surrounds the middle and oblique radial grooves stiffen the surround, both smooth cosines. The flange is at
z = 0, so the three states together fill the measuring range.
"""

from types import MappingProxyType

import numpy as np

from .parts import Part, Specimen
from .triangulation import ring_angles, ring_faces

OUTER_RADIUS_MM = 3.7
CLAMP_RADIUS_MM = 3.4
DEFLECTION_MM = MappingProxyType({"concave": -1.38, "equilibrated": 0.25, "raised": 1.38})

_CONCENTRIC = (1.2, 0.6, 0.03)  # radius of the groove's bottom, width, depth
_RADIAL = (2.3, 1.4, 0.04)  # middle radius of the grooves, their length along the radius, depth
_RADIAL_COUNT = 18
_TWIST = 0.4  # rad per mm: how oblique the grooves are
_EDGE_MM = 0.012  # distance of neighbouring vertices


def diaphragm(state: str) -> Specimen:
    """The diaphragm in ``state``: "concave", "equilibrated" or "raised". Smooth everywhere."""
    deflection = DEFLECTION_MM[state]
    rings = int(np.ceil(OUTER_RADIUS_MM / _EDGE_MM))
    radii = np.linspace(0.0, OUTER_RADIUS_MM, rings + 1)
    counts = [1, *np.maximum(6, np.ceil(2 * np.pi * radii[1:] / _EDGE_MM)).astype(int).tolist()]
    r, azimuth = np.repeat(radii, counts), ring_angles(counts)
    z, by_radius, by_azimuth = surface(r, azimuth, deflection)

    cos, sin = np.cos(azimuth), np.sin(azimuth)
    across = np.divide(by_azimuth, r, out=np.zeros_like(r), where=r > 0)
    gradient = np.stack([by_radius * cos - across * sin, by_radius * sin + across * cos], axis=-1)
    normals = np.column_stack([-gradient, np.ones(len(r))])
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    part = Part(np.column_stack([r * cos, r * sin, z]), ring_faces(counts), normals, "film")
    nominal = {
        "outer_diameter_mm": 2 * OUTER_RADIUS_MM,
        "clamp_diameter_mm": 2 * CLAMP_RADIUS_MM,
        "deflection_mm": deflection,
        "concentric_groove_depth_mm": _CONCENTRIC[2],
        "radial_groove_depth_mm": _RADIAL[2],
        "radial_groove_count": float(_RADIAL_COUNT),
    }
    return Specimen(f"diaphragm-{state}", (part,), nominal)


def surface(r: np.ndarray, azimuth: np.ndarray, deflection: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Height in mm at polar coordinates of equal shape, and its derivatives by ``r`` and by ``azimuth``.

    The deflection is that of a clamped circular plate under even pressure, w (1 - r²/R²)².
    """
    plate = np.maximum(0.0, 1 - (r / CLAMP_RADIUS_MM) ** 2)
    z = deflection * plate**2
    by_radius = -4 * deflection * plate * r / CLAMP_RADIUS_MM**2

    ring, ring_slope = _bump(r, *_CONCENTRIC)
    spokes, spokes_slope = _bump(r, *_RADIAL)
    phase = _RADIAL_COUNT * (azimuth - _TWIST * (r - _RADIAL[0]))
    wave, wave_slope = (1 + np.cos(phase)) / 2, -np.sin(phase) / 2
    z = z - ring - spokes * wave
    by_radius = by_radius - ring_slope - spokes_slope * wave + spokes * wave_slope * _RADIAL_COUNT * _TWIST
    return z, by_radius, -spokes * wave_slope * _RADIAL_COUNT


def _bump(r: np.ndarray, middle: float, width: float, height: float) -> tuple[np.ndarray, np.ndarray]:
    """One period of a raised cosine and its derivative by ``r``; zero outside ``width``."""
    phase = 2 * np.pi * (r - middle) / width
    inside = np.abs(phase) < np.pi
    value = np.where(inside, height * (1 + np.cos(phase)) / 2, 0.0)
    slope = np.where(inside, -height * np.pi / width * np.sin(phase), 0.0)
    return value, slope
