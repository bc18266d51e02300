"""What blur does to the phase of a tilted surface out of focus: it belongs to a place beside the pixel's.

A pixel sees the mean over the camera's stop. A ray through it at the angle a from the middle one meets the surface,
which lies h above the focus and rises by s along the ray's tilt, at x = a (h + s x), that is at a h (1 + s a) to second
order. Over a round stop a² is NA²/4 on average along each axis, so that the mean lies NA²/4 h s away. The projector's
light does the same to the phase: what comes through the upper half of its stop falls more steeply and counts for more,
by 1 - s a, and a place h above its focus sees through it a mirror that lies a h away.

An edge in the picture does not move along: the places at which the rays that meet it leave the focus are -a h, whose
mean is 0. So a spot's centre and its phase tell of two places, a distance of

    δ = 2 NA²/4 h s = D²/2 (z - z_focus) grad z

apart, in pixels on the right with D the radius of the disc of defocus per height and grad z the rise per pixel. On a
tilted board h grows along the slope, and the displacement looks like another tilt: heights would get another scale,
by the order of NA²/4. The blur of the camera's picture is measured; the projector's lens is taken to be its twin, as in
a Greenough microscope it is. What the lean of both paths makes of level surfaces is alike for all of them at a height,
and so belongs to the model that is fitted: only their rise in the world counts here.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from .bundle_data import SpotPhases
from .point_spread import PointSpread
from .spots import Spots

_LEAST_SPOTS = 3  # for a plane


def level_phases(
    phases: Sequence[SpotPhases], spots: Sequence[Spots], heights: np.ndarray, point_spread: PointSpread | None
) -> tuple[SpotPhases, ...]:
    """Phases as the spots' centres would have them on surfaces that lie level there.

    Parameters
    ----------
    phases, spots : one per posture
    heights : (postures, spots)
        World heights of the spots, mm; micrometres hardly matter.
    point_spread : PointSpread, optional
        Without, the phases stay as they are.
    """
    if point_spread is None:
        return tuple(phases)
    return tuple(
        replace(
            phase,
            phase_rad=phase.phase_rad
            - np.sum(phase.gradient_rad * displacement_px(seen.centres_px, z, point_spread), axis=1),
        )
        for phase, seen, z in zip(phases, spots, heights, strict=True)
    )


def displacement_px(pixels: np.ndarray, z: np.ndarray, point_spread: PointSpread) -> np.ndarray:
    """How far (n, 2) beside pixels (n, 2) of a plane at heights z (n,) the places lie to which their phases belong."""
    known = np.isfinite(pixels).all(axis=1)
    if known.sum() < _LEAST_SPOTS:
        return np.zeros_like(pixels)
    plane = np.column_stack([np.ones(known.sum()), pixels[known]])
    rise = np.linalg.lstsq(plane, z[known], rcond=None)[0][1:]  # mm per px along u and v
    return point_spread.defocus_px_per_mm**2 / 2 * point_spread.defocus_mm(pixels, z)[:, None] * rise
