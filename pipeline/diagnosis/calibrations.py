"""What a calibration's own file shows: boards, postures, and what its planes leave over."""

import numpy as np

from greenough.instrument.errors import InputError

from ..calibration import Calibration
from .boards import camera_of, check_boards, check_postures, check_scales, posture_names
from .finding import Finding, Yardstick


def yardstick_of(calibration: Calibration) -> Yardstick:
    """Its scale of heights in the middle of the range, and its rig's statement of what drifts unseen."""
    middle = calibration.phase_height.phase(np.full(calibration.camera.shape, _middle(calibration)))
    um_per_rad = 1e3 * float(np.nanmedian(np.abs(calibration.phase_height.slope(middle))))
    return Yardstick(um_per_rad, max(1e3 * calibration.known.table_drift_mm, 1e-3))


def diagnose_calibration(calibration: Calibration) -> list[Finding]:
    """Findings about the board and its postures."""
    yardstick, names = yardstick_of(calibration), posture_names(calibration)
    try:
        boards = check_boards(camera_of(calibration), calibration.board, names, yardstick)
    except InputError:
        boards = []  # too few postures for a camera of their own
    return [*boards, *check_scales(calibration, names, yardstick), *check_postures(calibration, yardstick)]


def _middle(calibration: Calibration) -> float:
    return (calibration.figures["z_low_mm"] + calibration.figures["z_high_mm"]) / 2
