"""What blur does to spots and phases of a tilted surface out of focus.

A pixel sees the mean over the camera's stop. A ray through it at the angle a from the middle one meets the surface,
which lies h above the focus and rises by s along the ray's tilt, at x = a (h + s x), that is at a h (1 + s a) to second
order. Over a round stop a² is NA²/4 on average along each axis, so that the mean lies NA²/4 h s away: half the gradient
of the blur's variance. The projector's light does the same to the phase: what comes through the upper half of its stop
falls more steeply and counts for more, by 1 - s a, and a place h above its focus sees through it a mirror that lies
a h away. So a phase on a slope belongs to a place beside its pixel's, by

    2 NA²/4 h s = D²/2 (z - z_focus) grad z,

in pixels on the right with D the radius of the disc of defocus per height and grad z the rise per pixel. An edge in the
picture does not move along, for the rays that meet it leave the focus at -a h, whose mean is 0; but a spot's fit, which
takes the blur to be alike all around, is pulled by how it grows (`spot_fit`).

On a tilted board h grows along the slope. What is moved then looks like another tilt, and heights get another scale, by
the order of NA²/4; nothing in the data would show it. The blur of the camera's picture is measured. The projector's
lens is taken to be its mirror image, as in a Greenough microscope it is: its focus leans the other way. What the lean
of both paths makes of the phase of level surfaces is alike for all of them at a height, and so belongs to the model
that is fitted: of phases only what the rise adds is put back.
"""

from dataclasses import replace

import numpy as np

from .bundle_data import SpotPhases
from .point_spread import PointSpread
from .spots import Spots

_LEAST_SPOTS = 3  # for a plane


def freed_from_blur(
    spots: Spots, phases: SpotPhases, z: np.ndarray, point_spread: PointSpread
) -> tuple[Spots, SpotPhases]:
    """A posture's spots where sharp ones would be, and phases as level surfaces would have them there.

    Parameters
    ----------
    spots : Spots
        Without ``blur_pull`` they stay where they are.
    phases : SpotPhases
        At the same spots.
    z : (spots,)
        World heights, mm; micrometres hardly matter.
    point_spread : PointSpread
    """
    pixels = spots.centres_px
    known = np.isfinite(pixels).all(axis=1)
    if known.sum() < _LEAST_SPOTS:
        return spots, phases
    plane = np.column_stack([np.ones(known.sum()), pixels[known]])
    rise = np.linalg.lstsq(plane, z[known], rcond=None)[0][1:]  # mm per px along u and v
    square = point_spread.defocus_px_per_mm**2
    pulled = np.zeros_like(pixels)
    if spots.blur_pull is not None:
        growth = square / 4 * point_spread.defocus_mm(pixels, z)[:, None] * (rise - point_spread.focus_rise(pixels))
        pulled = spots.blur_pull[:, None] * growth
    of_both_paths = replace(point_spread, focus_mm=(point_spread.focus_mm[0], 0.0, *point_spread.focus_mm[2:]))
    beside = square / 2 * of_both_paths.defocus_mm(pixels, z)[:, None] * rise
    phase = phases.phase_rad - np.sum(phases.gradient_rad * (pulled + beside), axis=1)
    return replace(spots, centres_px=pixels - pulled), replace(phases, phase_rad=phase)
