"""Where the spots of a board or a dot grating lie in space, by their centres in the picture and the heights in them."""

import numpy as np

from .calibration import Calibration
from .decode import PhaseMap
from .spots import Spots

REACH = 0.8
"""Of a spot's half axis, within which its heights are used."""

_LEAST_PIXELS = 6


def spot_points(phase_map: PhaseMap, spots: Spots, calibration: Calibration) -> np.ndarray:
    """Spots' centres in the calibrated frame, (spots, 3) mm, NaN where unseen.

    The height at a centre is that of the plane through the heights of the pixels within the spot; x and y follow on
    the camera's ray through the centre. The small difference of an ellipse's and a circle's centre is left in.

    Parameters
    ----------
    phase_map : PhaseMap
    spots : Spots
        As ``detect_spots`` found them in this phase map's background, on a board of any pitch.
    calibration : Calibration
    """
    z = calibration.phase_height.height(phase_map.absolute)
    points = np.full((len(spots.seen), 3), np.nan)
    for k in np.flatnonzero(spots.seen):
        (u, v), reach = spots.centres_px[k], REACH * spots.axes_px[k].min()
        cols = np.arange(int(np.ceil(u - reach)), int(u + reach) + 1)
        rows = np.arange(int(np.ceil(v - reach)), int(v + reach) + 1)
        du, dv = np.meshgrid(cols - u, rows - v)
        window = z[rows[0] : rows[-1] + 1, cols[0] : cols[-1] + 1]
        inside = (du**2 + dv**2 <= reach**2) & np.isfinite(window)
        if inside.sum() < _LEAST_PIXELS:
            continue
        design = np.column_stack([np.ones(inside.sum()), du[inside], dv[inside]])
        height = np.linalg.lstsq(design, window[inside], rcond=None)[0][:1]
        points[k] = calibration.rays.points_at(spots.centres_px[k : k + 1], height)[0]
    return points
