"""Frames, phase maps and a calibration of any size without rendering: what they hold is like a capture's.

The projector's columns run evenly over the picture, and a surface that lies higher by 1 mm moves the fringes on it by
``RAD_PER_MM``.
"""

import numpy as np

from greenough.instrument.rigfile import RigFile
from greenough.pipeline.calibration import Calibration, Residuals
from greenough.pipeline.calibration_uncertainty import CalibrationUncertainty
from greenough.pipeline.camera_model import CameraModel
from greenough.pipeline.fringes import FringeSet
from greenough.pipeline.phase_height import PhaseHeight
from greenough.pipeline.rays import rays_of_camera

RAD_PER_MM = 6.2  # of the paper's finest fringes, 12 degrees between the paths
_MARGIN = 0.02  # of the lit width, dark on either side of the picture


def frames(fringes: FringeSet, shape: tuple[int, int], noise_dn: float, seed: int = 1) -> np.ndarray:
    """A flat surface at z = 0 under the fringes, (frames, rows, cols) uint8, with normal noise of ``noise_dn``."""
    rng = np.random.default_rng(seed)
    column = _absolute(fringes, shape[1]) * fringes.periods[-1] / (2 * np.pi)
    stack = np.empty((fringes.frame_count, *shape), np.uint8)
    sets = zip(fringes.periods, fringes.steps, strict=True)
    shifts = [(period, n / steps) for period, steps in sets for n in range(steps)]
    for frame, (period, shift) in zip(stack, shifts, strict=True):
        grey = (118 + 84 * np.cos(2 * np.pi * (column / period + shift))).astype(np.float32)
        noise = rng.standard_normal(shape, dtype=np.float32)
        frame[...] = np.rint(np.clip(grey + np.float32(noise_dn) * noise, 0, 255))
    return stack


def plane_phases(fringes: FringeSet, shape: tuple[int, int], z_mm: np.ndarray) -> np.ndarray:
    """Absolute phases of planes at heights (planes,), (planes, rows, cols) float32, rad, bent a little as eq. 11 is."""
    shifts = RAD_PER_MM * z_mm / (1 + 0.004 * z_mm)
    lines = (_absolute(fringes, shape[1]) + shifts[:, None]).astype(np.float32)
    return np.repeat(lines[:, None], shape[0], axis=1)


def calibration(rig_file: RigFile) -> Calibration:
    """A calibration of every pixel of the rig's camera, with which its `frames` can be reconstructed."""
    shape, procedure = rig_file.camera.shape, rig_file.procedure.contract
    rows, cols = shape
    half_mm = (procedure.planes - 1) / 2 * procedure.plane_step_mm
    camera = CameraModel(22_683.0, 22_683.0, 0.0, (cols - 1) / 2, (rows - 1) / 2, 0.0, 0.0, 0.0, 0.0, shape)
    camera_from_world = np.diag([1.0, -1.0, -1.0, 1.0])
    camera_from_world[2, 3] = 224.56
    coefficients = np.zeros((*shape, 4), np.float32)
    coefficients[..., 0] = half_mm
    centre = _absolute(FringeSet(procedure.periods_px, procedure.steps), cols).astype(np.float32)
    z_range = np.empty((*shape, 2), np.float32)
    z_range[...] = -half_mm, half_mm
    nothing = np.full((1, 1), np.nan, np.float32)
    return Calibration(
        method="bundle",
        camera=camera,
        camera_from_world=camera_from_world,
        rays=rays_of_camera(camera, camera_from_world),
        phase_height=PhaseHeight(
            coefficients,
            np.repeat(centre[None], rows, axis=0),
            np.full(shape, RAD_PER_MM * half_mm, np.float32),
            z_range,
            np.ones(shape, bool),
        ),
        identity=rig_file.identity("benchmark", "benchmark"),
        board=rig_file.board.nominal,
        procedure=procedure,
        known=rig_file.uncertainty.contract,
        run="benchmark",
        exposures=procedure.exposures,
        figures={},
        residuals=Residuals(nothing[None], nothing[None], nothing, nothing[None], nothing),
        uncertainty=CalibrationUncertainty(
            np.array([-half_mm, half_mm]),
            np.array([0.0, rows - 1.0]),
            np.array([0.0, cols - 1.0]),
            np.zeros((1, 2, 2, 2, 3), np.float32),
            np.zeros(2),
        ),
    )


def _absolute(fringes: FringeSet, cols: int) -> np.ndarray:
    """Absolute phase of the finest fringes along a row of the picture, (cols,) float64, rad."""
    lit = fringes.periods[0]
    return 2 * np.pi / fringes.periods[-1] * np.linspace(_MARGIN * lit, (1 - _MARGIN) * lit, cols)
