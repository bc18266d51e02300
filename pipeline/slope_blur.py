"""What blur does to spots and phases of a tilted surface out of focus.

A pixel sees the mean over the camera's stop. A ray through it at the angle a from the middle one meets the surface,
which lies h above the focus and rises by s along the ray's tilt, at x = a (h + s x), that is at a h (1 + s a) to second
order. Over a round stop a² is NA²/4 on average along each axis, so that the mean lies NA²/4 h s away: half the gradient
of the blur's variance. The projector's light does the same to the phase: what comes through the upper half of its stop
falls more steeply and counts for more, by 1 - s a, and a place h above its focus sees through it a mirror that lies
a h away. So with D the radius of the disc of defocus per height and grad z the rise per pixel, a phase on a slope
belongs to a place beside its pixel's, by

    D²/4 (z - z_camera) grad z + D²/4 (z - z_projector) grad z

in pixels, the two z being the heights in focus. In the interior of a spot the rim cuts off the far skirt of the light,
more of it where blur is wider: the camera's part loses there a share of what the growth of the blur would have added.

Seen the other way, from the surface to the picture, an edge does not move along with the slope, for the rays that meet
it leave the focus at -a h, whose mean is 0. It moves as the surface in focus rises, by -D²/4 (z - z_camera) grad
z_camera. And a spot's fit lies where it is pulled to by the growth of the blur (`spot_fit`),

    -2 D²/4 (z - z_camera) grad (z - z_camera).

On a tilted board z - z_camera grows along the slope. What is moved then looks like another tilt, and heights get
another scale, by the order of NA²/4; nothing in the data would show it. The blur of the camera's picture is measured.
The projector's lens is taken to be its mirror image, as in a Greenough microscope it is: its focus leans the other way.
"""

from dataclasses import replace

import numpy as np

from .bundle_data import SpotPhases
from .point_spread import PointSpread
from .spots import Spots

FIT_PULL = -2.0
"""How far a spot's fitted centre goes along with half the gradient of the blur's variance."""

RIM_SHARE = 0.2
"""Of that, what the interior of a spot lacks of the camera's part: by computed pictures of spots, as its test has them;
somewhat more or less by the spot's size, the defocus and the fringes' period."""

_LEAST_SPOTS = 3  # for a plane


def freed_from_blur(
    spots: Spots,
    phases: SpotPhases,
    z: np.ndarray,
    point_spread: PointSpread,
    fit_pull: float = FIT_PULL,
    rim_share: float = RIM_SHARE,
) -> tuple[Spots, SpotPhases]:
    """A posture's spots where rays have them, and phases as level surfaces would have them there.

    Parameters
    ----------
    spots : Spots
    phases : SpotPhases
        At the same spots.
    z : (spots,)
        World heights, mm; micrometres hardly matter.
    point_spread : PointSpread
    fit_pull, rim_share : float
        0 for edges and places that were found otherwise than by fits to pictures.
    """
    pixels = spots.centres_px
    known = np.isfinite(pixels).all(axis=1)
    if known.sum() < _LEAST_SPOTS:
        return spots, phases
    plane = np.column_stack([np.ones(known.sum()), pixels[known]])
    rise = np.linalg.lstsq(plane, z[known], rcond=None)[0][1:]  # mm per px along u and v
    focus, lean, *others = point_spread.focus_mm
    projector = replace(point_spread, focus_mm=(focus, -lean, *others))
    per_mm2 = point_spread.defocus_px_per_mm**2 / 4
    camera_mm, projector_mm = (each.defocus_mm(pixels, z)[:, None] for each in (point_spread, projector))
    rise_of_focus = point_spread.focus_rise(pixels)
    growth = per_mm2 * camera_mm * (rise - rise_of_focus)
    moved = fit_pull * growth - per_mm2 * camera_mm * rise_of_focus
    beside = per_mm2 * (camera_mm + projector_mm) * rise - rim_share * growth
    phase = phases.phase_rad - np.sum(phases.gradient_rad * (moved + beside), axis=1)
    return replace(spots, centres_px=pixels - moved), replace(phases, phase_rad=phase)
