"""Claims about the study of a coarse stage: its prediction without frames, and frames in coarse pixels."""

from collections.abc import Sequence

import numpy as np
import pytest

from greenough.instrument.contract import BLANK, Placement
from greenough.pipeline.acquisition import plane_heights
from greenough.pipeline.calibration import Calibration
from greenough.pipeline.calibration_uncertainty import CalibrationUncertainty
from greenough.pipeline.camera_model import CameraModel
from greenough.pipeline.phase_height import PhaseHeight
from greenough.pipeline.rays import rays_of_camera
from greenough.twin.rig import open as open_twin
from greenough.twin.scene import axis_frame
from greenough.twin.validation import coarse_stage
from greenough.twin.validation.coarse_stage import (
    SHARE_LIMIT,
    binned,
    coarse_stage_claims,
    independent_errors_share,
    predicted_percentiles,
    steps,
)

# A whole field in pixels of 40 um.
COARSE = (
    "twin.optics.glass=false", "camera.rows=240", "camera.cols=320", "twin.optics.camera_focal_px=5670.75",
    "procedure.planes=10", "procedure.plane_step_mm=0.3",
)  # fmt: skip


# The same field in pixels of 20 um: the study bins them.
BINNED = (*COARSE, "camera.rows=480", "camera.cols=640", "twin.optics.camera_focal_px=11341.5")


def paper(settings: Sequence[str]) -> Calibration:
    """The ideal lens's camera, and no relation: the study makes its own."""
    rig, bench = open_twin("twin", settings)
    optics, (rows, cols) = bench.settings.optics, rig.camera.shape
    focal = optics.camera_focal_px
    camera = CameraModel(focal, focal, 0.0, (cols - 1) / 2, (rows - 1) / 2, 0.0, 0.0, 0.0, 0.0, (rows, cols))
    frame = axis_frame(-np.radians(optics.convergence_deg) / 2, optics.pupil_distance_mm)
    pose = np.diag([-1.0, -1.0, 1.0, 1.0]) @ np.linalg.inv(bench.world_from_twin @ frame)  # columns right, rows down
    nothing = PhaseHeight(*(np.zeros(0) for _ in range(5)))
    ends = (np.array([-1.5, 1.5]), np.array([0.0, rows - 1]), np.array([0.0, cols - 1]))
    certain = CalibrationUncertainty(*ends, np.zeros((0, 2, 2, 2, 3), np.float32), np.zeros(2))
    return Calibration(
        "paper", camera, pose, rays_of_camera(camera, pose), nothing, rig.identity, rig.board, rig.procedure,
        rig.uncertainty, "calibration", 0, {}, None, certain,
    )  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("settings", [COARSE, BINNED], ids=["coarse", "binned"])
def test_a_coarse_stage_errs_as_predicted_and_most_such_stages_by_more_than_the_limit(settings):
    """Errors of many um are predicted to what the grid of places, the picture's rim and coarse pixels leave open."""
    done = []
    rows = {row.claim: row for row in coarse_stage_claims("twin", settings, paper(settings), done.append)}
    rig, _ = open_twin("twin", COARSE)
    assert sum(done) == steps(rig)
    assert {row.specimen for row in rows.values()} == {"plane, stage of 10 um"}
    assert {row.calibration for row in rows.values()} == {"paper"}
    for name in ("depth_p95_volume", "depth_tilted_p95", "depth_systematic_rms", "depth_tilted_systematic_rms"):
        assert rows[name].measured == pytest.approx(rows[name].predicted, rel=0.15), name
    share, median = rows["stages_within_4um"], rows["stages_median_p95"]
    assert (share.limit, share.holds, share.expected_to_hold) == (SHARE_LIMIT, False, False)
    assert "without frames" in share.criterion
    assert median.measured > 4.0


def test_a_binned_camera_sees_a_point_where_the_middle_of_its_pixels_did():
    camera = CameraModel(22683.0, 22690.0, 3.0, 640.5, 478.0, 0.3, -20.0, 1e-4, -2e-4, (960, 1280))
    points = np.random.default_rng(1).uniform([-6, -4, 224], [6, 4, 226], (50, 3))
    coarse = binned(camera, 4)
    assert coarse.shape == (240, 320)
    assert np.allclose(4 * coarse.project(points) + 1.5, camera.project(points), rtol=0, atol=1e-9)


@pytest.mark.slow
def test_the_twin_in_coarse_pixels_sees_what_the_middles_of_fine_ones_saw():
    """Points of a flat face at full and at half the resolution, through glass: one instrument, but for its pixels."""
    fine = COARSE[1:4]
    half = coarse_stage._coarse_pixels("twin", fine, 2)
    truths = []
    for settings in (fine, (*fine, *half)):
        rig, bench = open_twin("twin", settings)
        rig.operator.place(Placement("board", face=BLANK))
        truths.append(bench.truth().xyz)
    whole, coarse = truths
    middles = whole.reshape(120, 2, 160, 2, 3).mean(axis=(1, 3))
    both = np.isfinite(middles).all(axis=-1) & np.isfinite(coarse).all(axis=-1)
    assert np.mean(both) > 0.5
    assert np.abs(middles - coarse)[both].max() < 1e-4  # mm: a four-hundredth of a pixel


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_share_of_stages_that_keep_the_limit_is_a_negative_control(seed):
    """At a true share of a half, 38 or more of 40 keep the limit in 1 of 10^9 draws."""
    settings = [*COARSE, f"twin.seed={seed}", "twin.stage.position_sd_um=10"]
    rig, _ = open_twin("twin", settings)
    others = np.array(list(predicted_percentiles("twin", settings, plane_heights(rig))))
    assert np.mean(others <= 4.0) < SHARE_LIMIT
    assert np.median(others) > 4.0
    # Pitch, roll and bow make it less: not more than the simple model's share and four deviations of 40 draws.
    simple = independent_errors_share(plane_heights(rig))
    assert 0 < simple < 0.5
    assert np.mean(others <= 4.0) < simple + 4 * np.sqrt(simple * (1 - simple) / len(others))


@pytest.mark.slow
def test_few_stages_of_10_um_keep_the_limit_and_all_exact_ones_do():
    """Exact stages leave the boards' bow alone, 2 um (1 σ) over 8 mm."""
    rig, _ = open_twin("twin", COARSE)
    readings = plane_heights(rig)
    coarse, exact = (
        np.array(list(predicted_percentiles("twin", [*COARSE, f"twin.stage.position_sd_um={sd}"], readings)))
        for sd in (10, 0)
    )
    assert np.mean(coarse <= 4.0) < 0.5
    assert np.mean(exact <= 4.0) > 0.8
