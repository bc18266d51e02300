"""Plain triangulation: a calibrated camera and a calibrated projector, each a pinhole with distortion."""

import numpy as np

from .calibration import Calibration
from .calibration_data import CalibrationData
from .posture_support import supported_calibration
from .stereo_calibration import calibrate_stereo


def calibrate_by_triangulation(data: CalibrationData) -> Calibration:
    """The camera as the paper calibrates it, the projector as an inverse camera at the same postures, both refined.

    What most systems do: the board is as drawn, lenses are Brown's, rays of each meet in one point. Spots are not
    estimated, and what the lenses do beyond the model goes into heights. Pixels are valid where postures support them,
    as `posture_support` decides.

    Raises
    ------
    InputError
        If the phases do not determine the projector.
    """
    stereo = calibrate_stereo(*data.sharp_postures, data.camera, data.board)
    camera = stereo.instrument.camera.camera
    nominal, radii = data.board.centres(), data.board.diameters() / 2
    residuals_px = data.centres_px - camera.project_circles(nominal, radii, stereo.camera_from_board)
    rmse_u, rmse_v = np.sqrt(np.nanmean(residuals_px**2, axis=(0, 1)))
    return supported_calibration(
        "triangulation",
        data,
        stereo.instrument,
        z_mm=stereo.spots_mm[..., 2],
        residuals_px=residuals_px,
        residuals_rad=stereo.residuals_rad,
        figures={
            "spots_used": int(np.isfinite(residuals_px).all(axis=-1).sum()),
            "spot_phases_used": int(np.isfinite(stereo.residuals_rad).sum()),
            "outliers": stereo.outliers,
            "reprojection_rmse_u_px": float(rmse_u),
            "reprojection_rmse_v_px": float(rmse_v),
            "skew_angle_deg": camera.skew_angle_deg,
            "print_sd_um": 1e3 * float(data.camera.print_sd_mm),
            "spot_noise_px": float(data.camera.noise_sd_px),
            "spot_phase_rmse_rad": float(np.sqrt(np.nanmean(stereo.residuals_rad**2))),
        },
    )
