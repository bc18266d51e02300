"""A calibration of a coarse camera as its file holds it, with residuals drawn at random."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from greenough.instrument.contract import KnownUncertainty, Procedure, RigIdentity, SpotBoard
from greenough.pipeline.calibration import Calibration, Residuals
from greenough.pipeline.calibration_uncertainty import CalibrationUncertainty
from greenough.pipeline.camera_model import CameraModel
from greenough.pipeline.phase_height import PhaseHeight
from greenough.pipeline.rays import Rays

SHAPE = (60, 80)
BOARD = SpotBoard(5, 7, 1.2, 0.8, 0.5, 8.0, ((2, 3), (2, 4), (1, 3)))


@pytest.fixture
def calibration() -> Callable[..., Calibration]:
    """Makes one of four postures, with ``changes`` of its fields; the first posture misses a spot."""

    def made(**changes: Any) -> Calibration:
        rng = np.random.default_rng(6)
        coefficients = np.tile(np.array([1.5, 0.0, 0.01, 0.0], np.float32), (*SHAPE, 1))
        centre = np.tile(np.linspace(100, 300, SHAPE[1], dtype=np.float32), (SHAPE[0], 1))
        spots = rng.normal(0, 0.01, (4, BOARD.rows * BOARD.cols, 2))
        spots[0, 0] = np.nan
        grid = np.stack(np.meshgrid(np.linspace(10, 70, BOARD.cols), np.linspace(10, 50, BOARD.rows)), axis=-1)
        centres = grid.reshape(1, -1, 2) + rng.normal(0, 2, (4, 1, 2)) + 0 * spots
        parts: dict[str, Any] = {
            "method": "bundle",
            "camera": CameraModel(100.0, 100.0, 0.0, 40.0, 30.0, 0.0, 0.0, 0.0, 0.0, SHAPE),
            "camera_from_world": np.eye(4),
            "rays": Rays(np.zeros((*SHAPE, 2), np.float32), np.zeros((*SHAPE, 2), np.float32)),
            "phase_height": PhaseHeight(
                coefficients, centre, np.full(SHAPE, 10.0, np.float32),
                np.tile(np.array([-1.5, 1.5], np.float32), (*SHAPE, 1)), np.ones(SHAPE, bool),
            ),
            "identity": RigIdentity("bench", "camera 1", "projector 1", "0" * 64),
            "board": BOARD,
            "procedure": Procedure((608.0, 40.0), (4, 12), 4, 5, 0.5, 0.8),
            "known": KnownUncertainty(3e-5, 5e-4, 5e-5),
            "run": "calibrate",
            "exposures": 0,
            "figures": {"method": "bundle", "postures_without_board": (), "reprojection_rmse_u_px": 0.01},
            "residuals": Residuals(
                centres, spots, spots[..., 0], rng.normal(0, 0.1, (5, 6, 8)).astype(np.float32),
                rng.uniform(1, 2, SHAPE).astype(np.float32),
            ),
            "uncertainty": CalibrationUncertainty(
                np.array([-1.5, 0.0, 1.5]), *(np.array([0.0, n - 1.0]) for n in SHAPE),
                np.full((1, 3, 2, 2, 3), 3e-4, np.float32), np.zeros(3),
            ),
        }  # fmt: skip
        return Calibration(**(parts | changes))

    return made
