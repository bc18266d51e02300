"""What the timings of a calibration's computing are taken of, and that its peers do the same."""

import numpy as np
import pytest

from greenough.instrument.rigfile import load_rig_file
from greenough.pipeline.bundle_method import calibrate_by_bundle
from greenough.pipeline.phase_height import fit_phase_height
from greenough.twin.settings import load_twin_file
from greenough.twin.validation.benchmarks.calibrating import (
    NOISE,
    calibrate_with_opencv,
    fit_one_pixel,
    noisy_planes,
    observed_data,
)
from greenough.twin.validation.observations import build, observe

COARSE = [
    "twin.optics.glass=false",
    "camera.rows=180",
    "camera.cols=240",
    "twin.optics.camera_focal_px=4253.0625",
    "twin.render.nodes_edges=16",
    "procedure.postures=7",
    "procedure.planes=10",
    "procedure.plane_step_mm=0.3",
]


@pytest.fixture(scope="module")
def observed():
    """The rig, its observations without rendering, and what is timed of them."""
    rig_file, settings = load_twin_file("twin", COARSE)
    seen = observe(build(rig_file, settings, "test"), NOISE, np.random.default_rng(2))
    return rig_file, seen, observed_data(rig_file, seen)


def test_scipy_fits_the_same_relation():
    """Both minimise the same squares: they differ by the last of our two steps, far less than the noise of 1.7 µm."""
    phases, z_mm = noisy_planes(load_rig_file("twin", ["camera.rows=6", "camera.cols=8"]))
    relation = fit_phase_height(phases, z_mm).relation
    t = np.linspace(-1, 1, 9)
    for row, col in np.ndindex(6, 8):
        m1, m0, n1, r3 = fit_one_pixel(phases[:, row, col], z_mm)
        w = (m1 * t + m0) / (n1 * t + 1)
        ours = relation.of_pixels((slice(row, row + 1), slice(col, col + 1)))
        heights = [ours.height(ours.phase_centre + at * ours.phase_half_range)[0, 0] for at in t]
        np.testing.assert_allclose(w + r3 * w**3, heights, atol=0.01e-3)


def test_opencv_sees_the_same_spots(observed):
    """Its reprojection error is the board's print error, as ours is."""
    rig_file, seen, data = observed
    theirs = calibrate_with_opencv(data.spots, data.board.centres(), rig_file.camera.shape)
    assert theirs == pytest.approx(np.hypot(*seen.camera.reprojection_rmse_px), rel=0.1)


@pytest.mark.slow
def test_the_phases_go_with_the_observations(observed):
    rig_file, seen, data = observed
    assert data.phases.shape == (10, *rig_file.camera.shape)
    blocks = [np.isfinite(phase).sum() / (rig_file.camera.shape[1] // 40) ** 2 for phase in data.phases]
    assert blocks == [len(plane.phase_rad) for plane in seen.data.planes[1:]]
    calibration = calibrate_by_bundle(data)
    # Means of 36 pixels.
    assert calibration.figures["block_noise_rad"] == pytest.approx(NOISE.pixel_phase_rad / 6, rel=0.2)
    assert calibration.figures["spot_phases_used"] > 300
