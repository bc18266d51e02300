"""A calibration of a camera of twelve pixels, for what only needs one."""

import numpy as np

from greenough.instrument.contract import KnownUncertainty, Procedure, RigIdentity, SpotBoard
from greenough.pipeline.calibration import Calibration, Residuals
from greenough.pipeline.calibration_uncertainty import CalibrationUncertainty
from greenough.pipeline.camera_model import CameraModel
from greenough.pipeline.phase_height import PhaseHeight
from greenough.pipeline.rays import Rays

SHAPE = (3, 4)
PROCEDURE = Procedure((64.0,), (4,), 16, 30, 0.1, 0.8, (4.0, 1.0))


def small_calibration(procedure: Procedure = PROCEDURE) -> Calibration:
    """Of zeros, as far as they will do."""
    nothing = np.full(SHAPE, np.nan, np.float32)
    return Calibration(
        method="bundle",
        camera=CameraModel(100.0, 100.0, 0.0, 2.0, 1.5, 0.0, 0.0, 0.0, 0.0, SHAPE),
        camera_from_world=np.eye(4),
        rays=Rays(np.zeros((*SHAPE, 2), np.float32), np.zeros((*SHAPE, 2), np.float32)),
        phase_height=PhaseHeight(
            np.zeros((*SHAPE, 4), np.float32),
            np.zeros(SHAPE, np.float32),
            np.ones(SHAPE, np.float32),
            np.zeros((*SHAPE, 2), np.float32),
            np.ones(SHAPE, bool),
        ),
        identity=RigIdentity("bench", "1", "2", "0" * 64),
        board=SpotBoard(5, 7, 1.2, 0.8, 0.5, 8.0, ((2, 3), (2, 4), (1, 3))),
        procedure=procedure,
        known=KnownUncertainty(3e-5, 5e-4, 5e-5),
        run="calibrate",
        exposures=0,
        figures={},
        residuals=Residuals(nothing[None], nothing[None], nothing, nothing[None], nothing),
        uncertainty=small_uncertainty(),
    )


def small_uncertainty(sigma_z_mm: float = 0.0) -> CalibrationUncertainty:
    """One cause, which lifts all points alike."""
    mode = np.zeros((1, 2, 2, 2, 3), np.float32)
    mode[..., 2] = sigma_z_mm
    return CalibrationUncertainty(
        np.array([-1.45, 1.45]), *(np.array([0.0, n - 1.0]) for n in SHAPE), mode, np.zeros(2)
    )
