"""What a rig was seen to do for its calibration: every method computes from the same."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from greenough.instrument.contract import KnownUncertainty, Procedure, RigIdentity, SpotBoard

from .bundle_data import SpotPhases, block_map
from .calibration import Calibration, Residuals
from .calibration_uncertainty import CalibrationUncertainty
from .camera_calibration import CameraCalibration
from .camera_model import CameraModel
from .instrument_model import InstrumentModel
from .method import Method
from .path_drift import walk_covariance
from .phase_height import PhaseHeight, PlanePhases
from .point_spread import PointSpread
from .rays import Rays
from .slope_blur import freed_from_blur
from .spots import Spots


@dataclass(frozen=True, eq=False)
class CalibrationData:
    """One acquisition, and the camera as the paper calibrates it.

    Parameters
    ----------
    identity, board, procedure, known
        Of the rig; the last is its `Rig.uncertainty`.
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
        The same at the planes, of which there are none where no method needed them: an array, or one in a file.
    readings_mm : (planes,)
        The stage's.
    """

    identity: RigIdentity
    board: SpotBoard
    procedure: Procedure
    known: KnownUncertainty
    run: str
    exposures: int
    spots: tuple[Spots, ...]
    spot_phases: tuple[SpotPhases, ...]
    exposures_at_postures: np.ndarray
    missing: tuple[str, ...]
    camera: CameraCalibration
    point_spread: PointSpread | None
    phase_at_zero: np.ndarray
    phases: PlanePhases
    readings_mm: np.ndarray

    @property
    def centres_px(self) -> np.ndarray:
        """Where the spots' centres were found, (postures, spots, 2); NaN where unseen."""
        return np.array([spots.centres_px for spots in self.spots])

    @property
    def sharp_postures(self) -> tuple[tuple[Spots, ...], tuple[SpotPhases, ...]]:
        """``spots`` and ``spot_phases`` freed from what blur does on tilted boards, if the point spread is known.

        Of dark spots it is another, which nobody has worked out: theirs stay as they are.
        """
        if self.point_spread is None or self.board.dark_spots:
            return self.spots, self.spot_phases
        heights = self.camera.spot_heights(self.board)
        freed = [
            freed_from_blur(spots, phases, z, self.point_spread)
            for spots, phases, z in zip(self.spots, self.spot_phases, heights, strict=True)
        ]
        return tuple(spots for spots, _ in freed), tuple(phases for _, phases in freed)

    @property
    def drift_share(self) -> float:
        """Exposures before the flat posture, which defines the world's frame, over those of a whole calibration."""
        return float(self.exposures_at_postures[self.camera.reference] / self.procedure.exposures)

    @property
    def path_drift_mm2(self) -> np.ndarray:
        """Covariance (postures, postures) of how far the projected picture had drifted in each posture."""
        return walk_covariance(self.known, self.procedure, self.exposures_at_postures)

    def posture_residuals(self, spots_px: np.ndarray, spot_phases_rad: np.ndarray) -> Residuals:
        """Residuals (postures, spots, 2) and (postures, spots) of a method without planes."""
        return Residuals(
            centres_px=self.centres_px,
            spots_px=spots_px,
            spot_phases_rad=spot_phases_rad,
            planes_um=np.empty((0, *block_map(self.phase_at_zero).shape), dtype=np.float32),
            pixels_um=np.full(self.phase_at_zero.shape, np.nan, dtype=np.float32),
        )

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
        uncertainty: CalibrationUncertainty,
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
            known=self.known,
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
            uncertainty=uncertainty,
            instrument=instrument,
            point_spread=self.point_spread,
        )
