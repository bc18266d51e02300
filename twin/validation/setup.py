"""One instrument under test: its rig, the bench with its truth, and the calibration that the pipeline made of it."""

from dataclasses import dataclass

import numpy as np

from greenough.instrument.contract import Frames, Placement
from greenough.pipeline.acquisition import plane_heights
from greenough.pipeline.calibration import Calibration
from greenough.pipeline.decode import PhaseMap, decode
from greenough.pipeline.exposure import auto_exposure
from greenough.pipeline.reconstruct import PointMap, reconstruct

from ..bench import Bench
from ..diffraction import airy_radius
from ..rig import TwinRig
from .claims import Claim, expectation

NO_FILTER = "none"


@dataclass(frozen=True)
class Setup:
    """A calibrated twin, ready to measure, in a run of its own.

    Setups of several calibrations share one rig: what one of them captures, all evaluate.
    """

    rig: TwinRig
    bench: Bench
    calibration: Calibration

    @property
    def airy_radius_px(self) -> float:
        """Radius of the Airy disc in camera pixels at the specimen: what smooth surroundings and filters refer to."""
        optics = self.bench.settings.optics
        pixel = optics.pupil_distance_mm / optics.camera_focal_px
        return airy_radius(optics.na, optics.wavelength_um * 1e-3) / pixel

    @property
    def filter_fwhm_px(self) -> float:
        """Width of the one filter that rows may use: the Airy diameter."""
        return 2 * self.airy_radius_px

    @property
    def filter_name(self) -> str:
        """How a filtered row names it."""
        return f"plane under a gaussian on phasors, fwhm {self.filter_fwhm_px:.2f} px"

    @property
    def believes_stage(self) -> bool:
        """Whether the calibration took the stage's readings for true heights."""
        return self.calibration.method == "paper"

    @property
    def readings(self) -> np.ndarray:
        """Stage positions of the calibration's planes, (planes,) mm."""
        return plane_heights(self.rig)

    def place(self, placement: Placement, position: float = 0.0) -> None:
        """Mount a part, move the stage, and expose for the part."""
        self.rig.operator.place(placement)
        self.rig.stage.move_to_mm(position)
        auto_exposure(self.rig)

    def frames(self) -> Frames:
        """One exposure of every fringe pattern."""
        return self.rig.capture(self.calibration.fringes.patterns(*self.rig.projector.shape))

    def decoded(self, frames: Frames) -> PhaseMap:
        """What ``frames`` say about each pixel."""
        return decode(frames, self.calibration.fringes, self.rig.camera.noise)

    def capture(self) -> PhaseMap:
        """One exposure of every fringe pattern, decoded."""
        return self.decoded(self.frames())

    def points(self, phase_map: PhaseMap) -> PointMap:
        """Points without any filter."""
        return reconstruct(phase_map, self.calibration)

    def height_sigma(self, phase_map: PhaseMap) -> np.ndarray:
        """Predicted standard deviation of z from this exposure's noise, (rows, cols) mm: |dz/dphase| times sigma."""
        return np.abs(self.calibration.phase_height.slope(phase_map.absolute)) * phase_map.sigma

    def claim(
        self,
        name: str,
        specimen: str,
        measured: float,
        unit: str,
        n: int,
        criterion: str,
        *,
        paper: float | None = None,
        limit: float | None = None,
        at_least: bool = False,
        holds: bool | None = None,
        expected_to_hold: bool | None = None,
        filter: str = NO_FILTER,
        alignment: str = "none",
        predicted: float | None = None,
        predicted_sd: float | None = None,
    ) -> Claim:
        """A row about this instrument.

        Without ``holds``, |measured| <= limit decides, or measured >= limit where the limit is ``at_least`` to be
        reached. Without ``expected_to_hold``, the same is asked of what is ``predicted``, and a limit within
        `TOSS_UP_SDS` of ``predicted_sd`` leaves it open. A row without a prediction, or with one that is not finite, is
        expected to hold.
        """
        if predicted is not None and not np.isfinite(predicted):
            predicted = predicted_sd = None
        expected: bool | None = True if expected_to_hold is None else expected_to_hold
        if limit is not None and holds is None:
            holds = measured >= limit if at_least else abs(measured) <= limit
            if predicted is not None and expected_to_hold is None:
                excess = limit - predicted if at_least else abs(predicted) - limit
                expected = expectation(excess <= 0, abs(excess), predicted_sd)
        return Claim(
            claim=name,
            specimen=specimen,
            paper=paper,
            measured=float(measured),
            unit=unit,
            n=int(n),
            filter=filter,
            alignment=alignment,
            calibration=self.calibration.method,
            seed=self.bench.settings.seed,
            limit=None if limit is None else float(limit),
            holds=None if holds is None else bool(holds),
            expected_to_hold=None if holds is None or expected is None else bool(expected),
            criterion=criterion,
            predicted=None if predicted is None else float(predicted),
            predicted_sd=None if predicted_sd is None else float(predicted_sd),
        )
