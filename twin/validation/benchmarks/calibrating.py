"""How long the computing of a calibration takes: every pixel's relation, the camera, the bundle; and one as a whole.

Run as a module it is the process in which the memory of the fit is measured.
"""

import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import cast

import cv2
import numpy as np
from scipy.optimize import curve_fit

from greenough.instrument.contract import Frames, Rig
from greenough.instrument.rigfile import RigFile, load_rig_file
from greenough.pipeline.acquisition import calibrate
from greenough.pipeline.bundle import solve_bundle
from greenough.pipeline.bundle_data import block_side
from greenough.pipeline.bundle_method import calibrate_by_bundle
from greenough.pipeline.calibration_data import CalibrationData
from greenough.pipeline.camera_calibration import calibrate_camera
from greenough.pipeline.fringes import FringeSet
from greenough.pipeline.phase_height import fit_phase_height
from greenough.pipeline.pixel_maps import model_maps
from greenough.pipeline.spots import Spots

from ...rig import open as open_twin
from ...settings import load_twin_file
from ..observations import Noise, Observations, build, observe
from . import synthetic
from .peak_memory import peak_mb
from .rows import Row, interleaved, limited

FIT, FIT_RATIO, FIT_MEMORY = "fit every pixel", "fit every pixel, against SciPy", "fit every pixel, peak memory"
CAMERA, ADJUSTMENT, BUNDLE = "calibrate the camera", "bundle adjustment", "calibrate by the bundle, from phases"
WHOLE, RENDERING, COMPUTING = "whole calibration", "whole calibration, capturing", "whole calibration, after capturing"

FIT_LIMIT_S = 10.0
SCIPY_LIMIT = 1e-3
MEMORY_LIMIT_MB = 1500.0
BUNDLE_LIMIT_S = 10.0
WHOLE_LIMIT_S = 100.0

NOISE = Noise(centre_px=0.004, spot_phase_rad=2e-4, pixel_phase_rad=0.011)
"""Of the size that rendered captures show: the time of the bundle hangs little on it."""

_SCIPY_PIXELS = 300
_REPEATS = 5
_BUNDLES = 2  # they take seconds, and their limit is far


def rows(rig_name: str, overrides: Sequence[str]) -> list[Row]:
    """The fit with SciPy as its peer, the camera's calibration with OpenCV's, and the bundle; nothing is rendered."""
    return [*fit_rows(rig_name, overrides), *bundle_rows(rig_name, overrides)]


def fit_rows(rig_name: str, overrides: Sequence[str]) -> list[Row]:
    """Fit all pixels to the procedure's planes; SciPy's loop is extrapolated from some hundred pixels."""
    phases, z_mm = noisy_planes(load_rig_file(rig_name, overrides))
    pixels = phases[0].size
    sample = phases.reshape(len(phases), pixels)[:, :: max(1, pixels // _SCIPY_PIXELS)]
    times = interleaved(
        {
            FIT: lambda: fit_phase_height(phases, z_mm),
            "SciPy": lambda: [fit_one_pixel(sample[:, k], z_mm) for k in range(sample.shape[1])],
        },
        _REPEATS,
    )
    loop = times["SciPy"] * pixels / sample.shape[1]
    arguments = [sys.executable, "-m", __name__, rig_name, *overrides]
    memory = float(subprocess.run(arguments, check=True, stdout=subprocess.PIPE).stdout)
    return [
        limited(FIT, times[FIT], "s", None, None, FIT_LIMIT_S),
        limited(FIT_RATIO, times[FIT], "s", "scipy.optimize.curve_fit in a loop", times[FIT] / loop, SCIPY_LIMIT),
        limited(FIT_MEMORY, memory, "MB", None, None, MEMORY_LIMIT_MB),
    ]


def noisy_planes(rig_file: RigFile) -> tuple[np.ndarray, np.ndarray]:
    """Phases (planes, rows, cols) float32 of the procedure's planes with the noise of single pixels, and heights."""
    procedure = rig_file.procedure
    z_mm = (np.arange(procedure.planes) - (procedure.planes - 1) / 2) * procedure.plane_step_mm
    phases = synthetic.plane_phases(FringeSet(procedure.periods_px, procedure.steps), rig_file.camera.shape, z_mm)
    rng = np.random.default_rng(1)
    for phase in phases:
        phase += np.float32(NOISE.pixel_phase_rad) * rng.standard_normal(phase.shape, dtype=np.float32)
    return phases, z_mm


def fit_one_pixel(phase: np.ndarray, z_mm: np.ndarray) -> np.ndarray:
    """m1, m0, n1, r3 of one pixel's phases (planes,), as somebody would fit them with SciPy.

    The same model in the same gauge, from the straight line through the ends.
    """
    seen = np.isfinite(phase)
    phase, z = phase[seen].astype(float), z_mm[seen]
    low, high = phase.min(), phase.max()
    t = (phase - (low + high) / 2) / ((high - low) / 2)
    first, last = z[t.argmin()], z[t.argmax()]
    return curve_fit(_height, t, z, p0=((last - first) / 2, (last + first) / 2, 0.0, 0.0))[0]


def _height(t: np.ndarray, m1: float, m0: float, n1: float, r3: float) -> np.ndarray:
    w = (m1 * t + m0) / (n1 * t + 1)
    return w + r3 * w * w * w


def bundle_rows(rig_name: str, overrides: Sequence[str]) -> list[Row]:
    """Camera, bundle adjustment, and everything that is computed once phases and spots are there."""
    rig_file, settings = load_twin_file(rig_name, overrides)
    seen = observe(build(rig_file, settings, "benchmark"), NOISE, np.random.default_rng(1))
    data = observed_data(rig_file, seen)
    readings = np.concatenate([[0.0], data.readings_mm])

    times = interleaved(
        {
            CAMERA: lambda: calibrate_camera(data.spots, data.board, rig_file.camera.shape, seen.camera.reference),
            "OpenCV": lambda: calibrate_with_opencv(data.spots, data.board.centres(), rig_file.camera.shape),
            ADJUSTMENT: lambda: solve_bundle(seen.data, data.camera, data.board, readings, data.path_drift_mm2),
            BUNDLE: lambda: calibrate_by_bundle(data),
        },
        _BUNDLES,
    )
    peer = "cv2.calibrateCamera"
    return [
        Row(CAMERA, times[CAMERA], "s", peer, times[CAMERA] / times["OpenCV"]),
        Row(ADJUSTMENT, times[ADJUSTMENT], "s", peer, times[ADJUSTMENT] / times["OpenCV"]),
        limited(BUNDLE, times[BUNDLE], "s", None, None, BUNDLE_LIMIT_S),
    ]


def calibrate_with_opencv(spots: Sequence[Spots], nominal: np.ndarray, shape: tuple[int, int]) -> float:
    """OpenCV's camera without skew from the same spots, k3 left out as here; its reprojection error, px."""
    on_board = np.column_stack([nominal, np.zeros(len(nominal))]).astype(np.float32)
    points = [on_board[found.seen] for found in spots]
    centres = [found.centres_px[found.seen].astype(np.float32) for found in spots]
    size = (shape[1], shape[0])
    camera = cv2.initCameraMatrix2D(points, centres, size)
    return cv2.calibrateCamera(points, centres, size, camera, np.zeros(5), flags=cv2.CALIB_FIX_K3)[0]


def observed_data(rig_file: RigFile, seen: Observations) -> CalibrationData:
    """What a rig would have been seen to do: the observations, and phases of all pixels that go with them.

    They are those of the bundle that fits the observations, where a block of the plane was observed, with noise.
    """
    shape, procedure = rig_file.camera.shape, rig_file.procedure.contract
    frames = sum(procedure.steps)
    data = CalibrationData(
        identity=rig_file.identity("benchmark", "benchmark"),
        board=rig_file.board.nominal,
        procedure=procedure,
        known=rig_file.uncertainty.contract,
        run="benchmark",
        exposures=int(seen.exposures_at_postures[-1]) + frames * len(seen.readings_mm),
        spots=seen.data.spots,
        spot_phases=seen.data.phases,
        exposures_at_postures=seen.exposures_at_postures,
        missing=(),
        camera=seen.camera,
        point_spread=None,
        phase_at_zero=np.full(shape, np.nan, dtype=np.float32),
        phases=np.empty((0, *shape), dtype=np.float32),
        readings_mm=seen.readings_mm[1:],
    )
    bundle = solve_bundle(seen.data, seen.camera, data.board, seen.readings_mm, data.path_drift_mm2)
    heights = bundle.state.planes[:, 0]
    rays, relation = model_maps(bundle.state.instrument, float(heights.min()), float(heights.max()))
    rng = np.random.default_rng(1)
    side = block_side(shape[1])
    phases = np.full((len(heights), *shape), np.nan, dtype=np.float32)
    for k, (phase, plane) in enumerate(zip(phases, seen.data.planes, strict=True)):
        points = rays.points(np.full(shape, heights[k]))
        z = bundle.plane_height(k, points[..., :2].reshape(-1, 2)).reshape(shape)
        mean = relation.phase(z)
        noise = NOISE.pixel_phase_rad * rng.standard_normal(shape)
        for u, v in (plane.pixels // side * side).astype(int):
            block = slice(v, v + side), slice(u, u + side)
            phase[block] = mean[block] + noise[block]
    return CalibrationData(**{**vars(data), "phase_at_zero": phases[0], "phases": phases[1:]})


class _Timed:
    """A rig that counts the seconds of its captures."""

    def __init__(self, rig: Rig):
        self._rig = rig
        self.seconds = 0.0

    def __getattr__(self, name: str) -> object:
        return getattr(self._rig, name)

    def capture(self, patterns: np.ndarray) -> Frames:
        start = time.perf_counter()
        frames = self._rig.capture(patterns)
        self.seconds += time.perf_counter() - start
        return frames


def whole_calibration_rows(rig_name: str, overrides: Sequence[str]) -> list[Row]:
    """Calibrate the twin by the bundle, once, from the first picture to the file; it takes minutes."""
    rig, _ = open_twin(rig_name, list(overrides), run="benchmark")
    timed = _Timed(rig)
    ends: list[float] = []
    with tempfile.TemporaryDirectory() as folder, rig:
        start = time.perf_counter()
        calibrate(
            cast(Rig, timed),
            Path(folder) / "calibration.h5",
            "benchmark",
            lambda steps: ends.append(time.perf_counter()),
        )
        seconds = time.perf_counter() - start
    return [
        limited(WHOLE, seconds, "s", None, None, WHOLE_LIMIT_S),
        Row(RENDERING, timed.seconds, "s", WHOLE, timed.seconds / seconds),
        Row(COMPUTING, start + seconds - ends[-1], "s", WHOLE, (start + seconds - ends[-1]) / seconds),
    ]


if __name__ == "__main__":
    planes, heights = noisy_planes(load_rig_file(sys.argv[1], sys.argv[2:]))
    print(peak_mb(lambda: fit_phase_height(planes, heights)))
