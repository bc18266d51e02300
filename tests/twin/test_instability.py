"""What changes from frame to frame moves the measurement by what its size predicts."""

import numpy as np
import pytest
from scipy.stats import chi2

from greenough.instrument.contract import Placement
from greenough.twin.camera import displaced
from greenough.twin.instability import Instability
from greenough.twin.renderer import mi
from greenough.twin.rig import TwinRig, fringe_patterns
from greenough.twin.settings import OpticsSettings, StabilitySettings

FINE = ("camera.rows=40", "camera.cols=60", "twin.optics.camera_focal_px=22683")  # the middle, in real pixels
STEPS, PERIOD = 12, 12.0
FALSE_ALARM = 1e-3


def changes(run: str = "test", exposures: int = 1104, **settings: float) -> Instability:
    return Instability(StabilitySettings(**settings), seed=1, run=run, exposures=exposures)


def has_sd(values: np.ndarray, sd: float) -> bool:
    """Whether independent normal ``values`` of zero mean have this standard deviation."""
    low, high = chi2.ppf([FALSE_ALARM / 2, 1 - FALSE_ALARM / 2], values.size)
    return low < float((values**2).sum()) / sd**2 < high


def phase(rig: TwinRig) -> np.ndarray:
    """Of the densest fringes, (rows, cols), from one capture."""
    frames = rig.capture(fringe_patterns(rig)[-STEPS:])
    turn = np.exp(-2j * np.pi * np.arange(STEPS) / STEPS)
    return np.angle(np.tensordot(turn, frames.stack.astype(float), axes=1))


def mounted(small, *overrides: str, part: str = "plane") -> TwinRig:
    rig, _ = small(*FINE, *overrides, perfect=True, noiseless=True)
    rig.operator.place(Placement(part))
    rig.camera.exposure_us = 50_000
    return rig


def test_flicker_scales_each_frame(small):
    steady = mounted(small)
    rig = mounted(small, "twin.stability.flicker=0.01")
    patterns = np.repeat(fringe_patterns(rig)[:1], 40, axis=0)
    light, still = (r.capture(patterns).stack - r.camera.black_level_dn for r in (rig, steady))
    factor = light / still
    np.testing.assert_allclose(factor, np.broadcast_to(factor[:, :1, :1], factor.shape), rtol=1e-4)
    assert has_sd(factor[:, 0, 0] - 1, 0.01)


def test_ambient_light_reaches_every_pixel(small):
    rig = mounted(small, "twin.light.ambient=0.1")
    dark = np.zeros((1, *rig.projector.shape), np.uint8)
    electrons = (rig.capture(dark).stack - mounted(small).capture(dark).stack) * rig.camera.noise.electrons_per_dn
    np.testing.assert_allclose(electrons, 0.1 * 75 * 50, rtol=1e-4)  # of 75 electrons per ms


def test_vibration_turns_the_phase_by_what_the_shifts_of_the_frames_make_of_it(small):
    """A frame whose fringe is early by d_k pulls the phase by 2/N d_k sin^2 (Phi + 2 pi k / N).

    The fringes stand still: moving the plane within itself must do nothing, raising it moves them by dPhi/dz.
    """
    rig = mounted(small, "twin.stability.vibration_um=1.0")
    moved, still = phase(rig), phase(mounted(small))
    shifts = changes(vibration_um=1.0).vibration(np.arange(STEPS))
    # 12 degrees between the paths: a plane raised by dz meets light from dz 2 sin 6 further on at the mirrors.
    raised = -shifts[:, 2] * 2 * np.sin(np.radians(6)) / (OpticsSettings().column_pitch_um * 1e-3)
    early = 2 * np.pi / PERIOD * raised
    angle = still[..., None] + 2 * np.pi * np.arange(STEPS) / STEPS
    expected = 2 / STEPS * (early * np.sin(angle) ** 2).sum(axis=-1)
    difference = np.angle(np.exp(1j * (moved - still)))
    assert np.abs(expected).max() > 5e-4
    # The outermost pixels know one neighbour only.
    assert np.abs(difference - expected)[:, 1:-1].max() < 0.1 * np.abs(expected).max()


def test_vibration_has_its_size_in_every_direction():
    shifts = changes(vibration_um=0.1).vibration(np.arange(400))
    for axis in range(3):
        assert has_sd(shifts[:, axis], 1e-4)


def test_drifts_reach_their_size_after_a_calibration():
    ends = [changes(f"run {k}", 300, table_drift_um=0.5, path_drift_um=0.05) for k in range(200)]
    assert has_sd(np.array([run.table_drift(300) for run in ends]), 5e-4)
    assert has_sd(np.array([run.path_drift(300) for run in ends]), 5e-5)
    assert has_sd(np.array([run.table_drift(75) for run in ends]), 2.5e-4)  # a random walk: half after a quarter
    assert not changes().table_drift(0).any()


def test_the_table_drifts_away_under_the_microscope(small):
    rig, bench = small(*FINE, "twin.stability.table_drift_um=20", perfect=True, noiseless=True, exposures_done=500)
    rig.operator.place(Placement("plane"))
    rig.capture(fringe_patterns(rig)[:1])
    drift = changes(table_drift_um=20).table_drift(500)
    assert np.linalg.norm(drift) > 1e-3
    np.testing.assert_allclose(bench.truth().xyz[..., 2], drift[2], atol=1e-6)


def test_the_paths_drift_apart(small):
    rig, _ = small(*FINE, "twin.stability.path_drift_um=3.0", perfect=True, noiseless=True, exposures_done=700)
    rig.operator.place(Placement("plane"))
    rig.camera.exposure_us = 50_000
    turned = np.angle(np.exp(1j * (phase(rig) - phase(mounted(small)))))
    drift = changes(path_drift_um=3.0).path_drift(700)
    assert abs(drift) > 3e-4
    np.testing.assert_allclose(
        turned, 2 * np.pi / PERIOD * drift / (OpticsSettings().column_pitch_um * 1e-3), rtol=0.02
    )


def test_a_resumed_run_drifts_on(small):
    pictures = []
    for before in (0, 2):
        rig, _ = small(*FINE, "twin.stability.table_drift_um=50", perfect=True, noiseless=True, exposures_done=before)
        rig.operator.place(Placement("plane"))
        for patterns in np.split(fringe_patterns(rig)[:4], 2)[before // 2 :]:
            last = rig.capture(patterns).stack
        pictures.append(last)
    np.testing.assert_array_equal(*pictures)


@pytest.mark.parametrize("shift", [(0.01, 0.0), (0.0, -0.02), (0.03, 0.01)])
@pytest.mark.parametrize(("rad_per_px", "shortfall"), [(0.3, 0.006), (0.8, 0.025)])
def test_a_displaced_picture_is_the_picture_elsewhere(shift, rad_per_px, shortfall):
    """Slopes of fourth order see a wave of k rad per pixel k^4 / 30 too flat; half the shift in radians is left out.

    On the ring next to the rim they are of second order, k^2 / 6 too flat.
    """
    rows, cols = 30, 40
    v, u = np.mgrid[:rows, :cols].astype(float)

    def wave(u, v):
        return 1 + 0.5 * np.sin(rad_per_px * (u + 0.6 * v))

    moved = np.array(displaced(mi.Float(wave(u, v).ravel().astype(np.float32)), (rows, cols), np.array(shift)))
    expected = wave(u - shift[0], v - shift[1])
    for ring, allowed in ((2, shortfall), (1, rad_per_px**2 / 6 + shortfall)):
        inner = np.s_[ring:-ring, ring:-ring]
        error, motion = moved.reshape(rows, cols) - expected, wave(u, v) - expected
        assert np.abs(error[inner]).max() < allowed * np.abs(motion[inner]).max()
