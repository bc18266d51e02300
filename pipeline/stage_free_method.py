"""The stage-free calibration: the bundle from tilted postures alone, without blank planes, turning over, or a stage."""

import numpy as np

from .bundle import solve_bundle
from .bundle_data import BundleData
from .bundle_method import posture_figures
from .calibration import Calibration
from .calibration_data import CalibrationData
from .posture_support import supported_calibration


def calibrate_by_postures(data: CalibrationData) -> Calibration:
    """Fit camera, projector, spots and postures together, and turn the model into maps where postures support it.

    The same model as the bundle's, with the same scale: the board's pitch and the rigidity of the tilted board. What
    planes add there is a view of all places at all heights; here a pixel is valid at the heights at which spots with a
    phase were seen around it, as `posture_support` decides.

    Raises
    ------
    InputError
        If there are too few phases at spots, or they do not determine the projector.
    """
    observed = BundleData(*data.sharp_postures, ())
    bundle = solve_bundle(observed, data.camera, data.board, np.empty(0), data.path_drift_mm2)
    poses, spots = bundle.state.world_from_board, bundle.state.spots(bundle.board)
    return supported_calibration(
        "stage-free",
        data,
        bundle.state.instrument,
        z_mm=(spots @ poses[:, 2, :3].T + poses[:, 2, 3]).T,
        residuals_px=bundle.residuals_px,
        residuals_rad=bundle.residuals_rad,
        figures=posture_figures(bundle),
    )
