"""What a rig was seen to do for its calibration: every method computes from the same."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from greenough.instrument.contract import KnownUncertainty, Procedure, RigIdentity, SpotBoard

from .bundle_data import SpotPhases
from .calibration import Calibration, Method, Residuals
from .camera_calibration import CameraCalibration
from .camera_model import CameraModel
from .instrument_model import InstrumentModel
from .phase_height import PhaseHeight
from .point_spread import PointSpread
from .rays import Rays
from .spots import Spots


@dataclass(frozen=True, eq=False)
class CalibrationData:
    """One acquisition, and the camera as the paper calibrates it.

    Parameters
    ----------
    identity, board, procedure, uncertainty
        Of the rig.
    run : str
        Name of the run whose exposures went in.
    exposures : int
        How many that run had taken at the end.
    spots : tuple of Spots
        One per posture in which the board was found.
    spot_phases : tuple of SpotPhases
        Of the same postures.
    exposures_at_postures : (postures,) int
        How many the run had taken when each of these postures was done: how far drifts may have got.
    missing : tuple of str
        Postures in which the board was not found.
    camera : CameraCalibration
        From the spots at their nominal places; its reference is the flat posture.
    point_spread : PointSpread or None
        Of the camera; None where the spots were too few to tell.
    phase_at_zero : (rows, cols) float32
        Absolute phase of the blank side where the flat board lay, rad; NaN where invalid, and if no method needed it.
    phases : (planes, rows, cols) float32
        The same at the planes, of which there are none where no method needed them.
    readings_mm : (planes,)
        The stage's.
    """

    identity: RigIdentity
    board: SpotBoard
    procedure: Procedure
    uncertainty: KnownUncertainty
    run: str
    exposures: int
    spots: tuple[Spots, ...]
    spot_phases: tuple[SpotPhases, ...]
    exposures_at_postures: np.ndarray
    missing: tuple[str, ...]
    camera: CameraCalibration
    point_spread: PointSpread | None
    phase_at_zero: np.ndarray
    phases: np.ndarray
    readings_mm: np.ndarray

    @property
    def centres_px(self) -> np.ndarray:
        """Where the spots' centres were found, (postures, spots, 2); NaN where unseen."""
        return np.array([spots.centres_px for spots in self.spots])

    def calibration(
        self,
        method: Method,
        *,
        camera: CameraModel,
        camera_from_world: np.ndarray,
        rays: Rays,
        phase_height: PhaseHeight,
        figures: Mapping[str, Any],
        residuals: Residuals,
        instrument: InstrumentModel | None = None,
    ) -> Calibration:
        """What a method computed, with whose it is; figures that all methods have are put before its own."""
        return Calibration(
            method=method,
            camera=camera,
            camera_from_world=camera_from_world,
            rays=rays,
            phase_height=phase_height,
            identity=self.identity,
            board=self.board,
            procedure=self.procedure,
            run=self.run,
            exposures=self.exposures,
            figures={
                "method": method,
                "postures_used": len(self.spots),
                "postures_without_board": self.missing,
                "calibrated_pixels": int(phase_height.valid.sum()),
                **figures,
            },
            residuals=residuals,
            instrument=instrument,
            point_spread=self.point_spread,
        )
