"""What a rig was seen to do for its calibration: every method computes from the same."""

from dataclasses import dataclass

import numpy as np

from greenough.instrument.contract import KnownUncertainty, Procedure, RigIdentity, SpotBoard

from .bundle_data import SpotPhases
from .camera_calibration import CameraCalibration
from .point_spread import PointSpread
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
        Absolute phase of the blank side where the flat board lay, rad, NaN where invalid, and where no method needed it.
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
