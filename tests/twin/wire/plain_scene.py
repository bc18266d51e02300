"""A scene of plain geometry for an emulated rig, and how wrong a calibration of it is."""

from collections.abc import Callable, Iterator
from functools import lru_cache

import numpy as np

from greenough.instrument.contract import Frames, Placement
from greenough.pipeline.calibration import Calibration
from greenough.pipeline.decode import PhaseMap
from greenough.pipeline.reconstruct import reconstruct
from plain_rig import BOARD, SHAPE, TABLE_FROM_FLAT, pose_of, rays, scene

PERIODS_PX, STEPS = (608.0, 80.0, 12.0), (4, 4, 5)  # 13 patterns: one more than the projector's memory holds
SETTINGS = (
    f"camera.rows={SHAPE[0]}",
    f"camera.cols={SHAPE[1]}",
    f"board.rows={BOARD.rows}",
    f"board.cols={BOARD.cols}",
    f"board.pitch_mm={BOARD.pitch_mm}",
    f"board.big_diameter_mm={BOARD.big_diameter_mm}",
    f"board.small_diameter_mm={BOARD.small_diameter_mm}",
    f"board.size_mm={BOARD.size_mm}",
    f"board.big={[list(place) for place in BOARD.big]}",
    f"procedure.periods_px={list(PERIODS_PX)}",
    f"procedure.steps={list(STEPS)}",
    "procedure.postures=6",  # no fewer will do, nor fewer planes
    "procedure.planes=8",
    "procedure.plane_step_mm=0.3",
)
"""Of a rig file that shows this scene in a short calibration."""

_ELECTRONS_PER_DN, _BLACK_DN = 25.9, 4
_TILTED, _NOTHING = Placement("tilted plane"), Placement("nothing")
_NOISE = np.random.default_rng(1).standard_normal(1 << 21, dtype=np.float32)
_look = lru_cache(maxsize=64)(scene)


class PlainScene:
    """A ``Scene``: what lies there is seen by pinholes, and each exposure has noise of its own.

    Parameters
    ----------
    seed : int
        Of the noise.
    on_place : callable
        Called with each placement before it is carried out; what it raises becomes of it.
    """

    def __init__(self, seed: int = 1, on_place: Callable[[Placement], None] = lambda placement: None):
        self._seed, self._on_place = seed, on_place
        self._placement: Placement | None = None
        self._z_mm = 0.0

    def place(self, placement: Placement) -> None:
        self._on_place(placement)
        self._placement = placement

    def move_to_mm(self, position: float) -> None:
        self._z_mm = position

    def expose(self, patterns: np.ndarray, exposure_us: float, serial: int, began: int, lamp: float) -> np.ndarray:
        """Frames (N, rows, cols) uint8. An empty table is dark, and so is everything without light."""
        frames = np.empty((len(patterns), *SHAPE), dtype=np.uint8)
        for n, (frame, electrons) in enumerate(zip(frames, self._electrons(patterns, exposure_us, lamp), strict=True)):
            first = np.random.default_rng([self._seed, serial + n]).integers(len(_NOISE) - frame.size)
            noise = _NOISE[first : first + frame.size].reshape(SHAPE)
            frame[:] = np.clip(np.rint((electrons + _sd(electrons) * noise) / _ELECTRONS_PER_DN + _BLACK_DN), 0, 255)
        return frames

    def worst_deviation(self, frames: Frames, patterns: np.ndarray) -> float:
        """How far the frames of ``patterns`` are from what lies there now, in standard deviations of the noise.

        Every eighth pixel of each eighth row is looked at. Infinite where the stage is said to be elsewhere.
        """
        if abs(frames.stage_position_mm - self._z_mm) > 1e-9 or len(frames.stack) != len(patterns):
            return np.inf
        worst = 0.0
        electrons = self._electrons(patterns, frames.exposure_us, 1.0, slice(None, None, 8))
        for frame, expected in zip(frames.stack[:, ::8, ::8], electrons, strict=True):
            dn = np.clip(expected / _ELECTRONS_PER_DN + _BLACK_DN, 0, 255)
            beyond_rounding = np.maximum(np.abs(frame - dn) - 0.5, 0)
            worst = max(worst, float((beyond_rounding * _ELECTRONS_PER_DN / _sd(expected)).max()))
        return worst

    def _electrons(
        self, patterns: np.ndarray, exposure_us: float, lamp: float, every: slice = slice(None)
    ) -> Iterator[np.ndarray]:
        light, column = (seen[every, every] for seen in _look(self._placement or _NOTHING, False, round(self._z_mm, 9)))
        brightness = light * (_ELECTRONS_PER_DN * 0.4 * lamp * exposure_us / 8000) * (self._placement is not None)
        left = np.clip(column.astype(int), 0, 606)
        share = np.clip(column - left, 0, 1)
        for line in patterns[:, 0].astype(float):
            yield brightness * (line[left] * (1 - share) + line[left + 1] * share)


def _sd(electrons: np.ndarray) -> np.ndarray:
    """Of shot noise and the camera's own."""
    return np.sqrt(electrons + 100.0)


def largest_error_um(calibration: Calibration) -> float:
    """Of the heights of a tilted plane whose phases are known without noise: what the calibration does wrong.

    Infinite where it knows too few of the pixels.
    """
    light, column = scene(_TILTED, False, 0.0)
    valid = light > 0
    phase = np.where(valid, 2 * np.pi * column / PERIODS_PX[-1], np.nan).astype(np.float32)
    ones = np.ones(SHAPE, np.float32)
    points = reconstruct(PhaseMap(phase, 100 * ones, 100 * ones, valid, 0 * ones, 1e-3 * ones), calibration)
    if points.valid.mean() < 0.4:
        return np.inf
    error_mm = (points.xyz - _true_points())[points.valid]
    return 1e3 * float(np.abs(error_mm[:, 2]).max())


def _true_points() -> np.ndarray:
    """Where each pixel's ray meets the tilted plane, (rows, cols, 3) mm in the frame of the flat board."""
    origin, direction = rays()
    pose = pose_of(_TILTED)
    way = (pose[:3, 3] - origin) @ pose[:3, 2] / (direction @ pose[:3, 2])
    hit = origin + direction * way[..., None]
    return (hit - TABLE_FROM_FLAT[:3, 3]) @ np.linalg.inv(TABLE_FROM_FLAT[:3, :3]).T
