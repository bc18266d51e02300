"""The z stage as it really moves, and how parts lie on its table.

The twin's frame has z along the stage's nominal axis, up towards the microscope, and the origin where both optical axes
meet. The table's frame has its origin on the axis and z along the table's normal; a part's middle of height is at its
z = 0. Rigid motions are (4, 4) matrices ``to_from``.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from .randomness import instrument_rng
from .settings import StageSettings

CORRELATION_MM = 0.03  # errors at two calibration heights, 0.1 mm apart, are independent
_WAVES = 64


@dataclass(frozen=True)
class ErrorCurve:
    """A smooth random function of position with zero mean over the instruments and a given standard deviation.

    A sum of cosines with Gaussian wave numbers and uniform phases: a Gaussian process with the correlation
    exp(-(dz / correlation)^2 / 2), evaluated anywhere without storing it.
    """

    wave_number: np.ndarray  # (waves,) rad/mm
    phase: np.ndarray  # (waves,)
    sd: float

    def __call__(self, z: float) -> float:
        return float(self.sd * np.sqrt(2 / _WAVES) * np.cos(self.wave_number * z + self.phase).sum())


@dataclass(frozen=True)
class StageErrors:
    """One stage as it was built: height, two straightnesses (mm), pitch and roll (rad), and the axis."""

    height: ErrorCurve
    straight_x: ErrorCurve
    straight_y: ErrorCurve
    pitch: ErrorCurve
    roll: ErrorCurve
    axis_tilt: np.ndarray  # (2,) rad, rotation of the table about x and y against the stage's axis

    def twin_from_table(self, position: float) -> np.ndarray:
        """Where the table really is, (4, 4), when the stage reads ``position``."""
        tilt_x = self.axis_tilt[0] + self.pitch(position)
        tilt_y = self.axis_tilt[1] + self.roll(position)
        shift = [self.straight_x(position), self.straight_y(position), position + self.height(position)]
        return rigid(Rotation.from_rotvec([tilt_x, tilt_y, 0.0]), shift)


def build_stage(settings: StageSettings, seed: int) -> StageErrors:
    """Draw one stage. The numbers drawn do not depend on the sizes of the errors."""
    rng = instrument_rng(seed, "stage")

    def curve(sd: float) -> ErrorCurve:
        return ErrorCurve(rng.normal(0, 1 / CORRELATION_MM, _WAVES), rng.uniform(0, 2 * np.pi, _WAVES), sd)

    straight, angle = settings.straightness_sd_um * 1e-3, settings.pitch_roll_sd_urad * 1e-6
    curves = [curve(sd) for sd in (settings.position_sd_um * 1e-3, straight, straight, angle, angle)]
    return StageErrors(*curves, axis_tilt=rng.normal(0, 1, 2) * np.radians(settings.axis_sd_deg))


def rigid(rotation: Rotation, shift: np.ndarray | list[float]) -> np.ndarray:
    """The (4, 4) motion that rotates and then shifts."""
    motion = np.eye(4)
    motion[:3, :3] = rotation.as_matrix()
    motion[:3, 3] = shift
    return motion
