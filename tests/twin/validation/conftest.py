"""A setup without a renderer: what the claims need of rig, bench and calibration, each set by the test."""

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from greenough.instrument.contract import Procedure, SpotBoard
from greenough.pipeline.camera_model import CameraModel
from greenough.pipeline.rays import rays_of_camera
from greenough.twin.settings import StabilitySettings, TwinSettings
from greenough.twin.validation.setup import Setup

PROCEDURE = Procedure((608.0, 152.0, 40.0, 12.0), (4, 4, 4, 12), 16, 30, 0.1, 0.8)
BOARD = SpotBoard(9, 11, 0.65, 0.4, 0.175, 8.0, ((4, 5), (4, 6), (3, 5), (4, 3), (6, 5)))


@pytest.fixture
def analytic() -> Callable[..., Setup]:
    """Makes a setup of given parts of the bench; its calibration takes phases for heights. Nothing drifts."""

    def made(world_from_part: np.ndarray | None = None, method: str = "paper", **bench: Any) -> Setup:
        settings = TwinSettings(seed=5, stability=StabilitySettings(table_drift_um=0.0, path_drift_um=0.0))
        motion = np.eye(4) if world_from_part is None else world_from_part
        camera = CameraModel(22683.0, 22683.0, 0.0, 639.5, 479.5, 0.0, 0.0, 0.0, 0.0, (960, 1280))
        above = np.diag([1.0, -1.0, -1.0, 1.0])
        above[2, 3] = 224.56
        calibration = SimpleNamespace(
            method=method,
            camera=camera,
            rays=rays_of_camera(camera, above),
            camera_from_world=above,
            board=BOARD,
            fringes=SimpleNamespace(periods=PROCEDURE.periods_px, steps=PROCEDURE.steps),
            procedure=PROCEDURE,
            run="calibration",
            exposures=(16 + 1 + 30) * 24 + 5,
            figures={"method": "paper", "reprojection_rmse_u_px": 0.06, "postures_without_board": ()},
            phase_height=SimpleNamespace(height=lambda phase: phase, slope=np.ones_like),
            residuals=None,
        )
        rig = SimpleNamespace(
            procedure=PROCEDURE,
            stage=SimpleNamespace(limits_mm=(-1.6, 1.6)),
            identity=SimpleNamespace(settings_sha256="0" * 64),
        )
        ideal = {
            "blank_face_height": lambda reading, xy: np.full(len(xy), float(reading)),
            "printed_centres": BOARD.centres(),
        }
        parts = {"settings": settings, "world_from_part": motion} | ideal | bench
        return Setup(rig, SimpleNamespace(**parts), calibration)

    return made
