"""A chirp: a relief whose period falls from one side to the other, at constant amplitude.

Heights are A cos φ(x). The period falls evenly on a logarithmic scale, p(x) = p0 exp(-r (x - x0)) from p0 at -x to p1
at +x, so φ(x) = 2π (exp(r (x - x0)) - 1) / (r p0); after N whole periods it has reached p1 where r = (p0 / p1 - 1) /
(N p0). Across, the relief does not change. The optics' resolution, 0.021 mm by its Airy radius, lies within the range
of half periods. The amplitude is small against the depth of focus, and against the fringes' relation of height and
phase.
"""

import numpy as np

from .parts import Part, Specimen
from .triangulation import grid_faces

AMPLITUDE_MM = 0.004
PERIODS_MM = (0.4, 0.032)
PERIOD_COUNT = 64
WIDTH_MM = 5.6  # across

_RATE = (PERIODS_MM[0] / PERIODS_MM[1] - 1) / (PERIOD_COUNT * PERIODS_MM[0])
LENGTH_MM = float(np.log(PERIODS_MM[0] / PERIODS_MM[1]) / _RATE)

_MARGIN_MM = 0.4  # flat, at the height of the first and the last crest
_PER_PERIOD = 60  # vertices
_ROW_MM = 0.1  # distance of vertices across


def chirp() -> Specimen:
    """The relief on a plate that is a little longer, of matte ceramic."""
    return Specimen(
        "chirp",
        (_plate(),),
        {
            "length_mm": LENGTH_MM,
            "width_mm": WIDTH_MM,
            "amplitude_mm": AMPLITUDE_MM,
            "longest_period_mm": PERIODS_MM[0],
            "shortest_period_mm": PERIODS_MM[1],
            "period_count": float(PERIOD_COUNT),
        },
    )


def period(x: np.ndarray) -> np.ndarray:
    """Local period in mm at ``x`` in mm: the length over which the phase grows by 2π."""
    return PERIODS_MM[0] * np.exp(-_RATE * (x + LENGTH_MM / 2))


def relief(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Height in mm at ``x`` in mm, and its derivative; beyond the chirp's ends it goes on flat."""
    inside = np.clip(x, -LENGTH_MM / 2, LENGTH_MM / 2)
    phase = 2 * np.pi * np.expm1(_RATE * (inside + LENGTH_MM / 2)) / (_RATE * PERIODS_MM[0])
    slope = -AMPLITUDE_MM * 2 * np.pi / period(inside) * np.sin(phase)
    return AMPLITUDE_MM * np.cos(phase), np.where(inside == x, slope, 0.0)


def _plate() -> Part:
    # Vertices evenly in phase: as many on each period.
    count = np.arange(PERIOD_COUNT * _PER_PERIOD + 1) / _PER_PERIOD
    inside = np.log1p(count * _RATE * PERIODS_MM[0]) / _RATE - LENGTH_MM / 2
    side = np.array([LENGTH_MM / 2 + _MARGIN_MM])
    x = np.concatenate([-side, inside, side])
    half = WIDTH_MM / 2
    y = np.linspace(-half, half, round(WIDTH_MM / _ROW_MM) + 1)
    z, slope = relief(x)
    shape = (len(y), len(x))
    vertices = np.stack([*np.meshgrid(x, y), np.broadcast_to(z, shape)], axis=-1).reshape(-1, 3)
    normal = np.column_stack([-slope, np.zeros(len(x)), np.ones(len(x))])
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    normals = np.tile(normal, (len(y), 1))
    return Part(vertices, grid_faces(*shape), normals, "ceramic")
