"""What does not stay as it is between two frames: the light, the specimen's place, and the paths' directions.

Everything is drawn for an exposure of a run by its serial number, so that an interrupted run goes on as it would have.
Shifts are in the twin's frame.
"""

from dataclasses import dataclass

import numpy as np

from .randomness import exposure_rng, run_rng
from .settings import StabilitySettings


@dataclass(frozen=True)
class Instability:
    """One run of one instrument.

    Parameters
    ----------
    settings : StabilitySettings
    exposures : int
        In one calibration, at whose end the drifts reach their standard deviation.
    """

    settings: StabilitySettings
    seed: int
    run: str
    exposures: int

    def flicker(self, serials: np.ndarray) -> np.ndarray:
        """Light of each frame, relative to its mean, (N,)."""
        return 1 + self.settings.flicker * self._per_frame("flicker", serials, 1)[:, 0]

    def vibration(self, serials: np.ndarray) -> np.ndarray:
        """Shift of the specimen in each frame, (N, 3) mm."""
        return self.settings.vibration_um * 1e-3 * self._per_frame("vibration", serials, 3)

    def table_drift(self, serial: int) -> np.ndarray:
        """Shift of the specimen's table against the microscope, (3,) mm: a random walk from 0."""
        return self.settings.table_drift_um * 1e-3 * self._walk("table", serial, 3)

    def path_drift(self, serial: int) -> float:
        """Shift of the projected picture against the camera, along its columns, mm at the specimen."""
        return float(self.settings.path_drift_um * 1e-3 * self._walk("path", serial, 1)[0])

    def _per_frame(self, what: str, serials: np.ndarray, dimensions: int) -> np.ndarray:
        draws = [exposure_rng(self.seed, self.run, int(s), what).standard_normal(dimensions) for s in serials]
        return np.array(draws).reshape(len(serials), dimensions)

    def _walk(self, what: str, serial: int, dimensions: int) -> np.ndarray:
        """Of unit standard deviation after ``exposures`` steps."""
        steps = run_rng(self.seed, self.run, what).standard_normal((serial, dimensions))
        return steps.sum(axis=0) / np.sqrt(self.exposures)
