"""All calibrations of one recorded acquisition on a small twin, and where truth says their points lie."""

from dataclasses import dataclass

import numpy as np
import pytest

import greenough.twin
from greenough.instrument.contract import Placement
from greenough.instrument.recording import record
from greenough.instrument.replay import open_recording
from greenough.pipeline.acquisition import METHODS, calibrate_by_methods, plane_heights
from greenough.pipeline.calibration import Calibration
from greenough.pipeline.decode import decode
from greenough.pipeline.exposure import auto_exposure
from greenough.pipeline.reconstruct import reconstruct
from greenough.twin.validation.mechanics import systematic_error

pytestmark = pytest.mark.slow

# Pixels of 20 µm and spots larger in proportion; a stage of ±10 µm that spoils a step.
SMALL = (
    "camera.rows=480", "camera.cols=640", "twin.optics.camera_focal_px=11341.5", "twin.render.nodes=8",
    "board.small_diameter_mm=0.25", "board.big_diameter_mm=0.45", "procedure.postures=12", "procedure.planes=10",
    "procedure.plane_step_mm=0.3", "twin.render.bounces=1", "twin.stage.position_sd_um=10",
    "twin.seed=2",
)  # fmt: skip
HEIGHTS = (-1.25, 1.25)


@dataclass(frozen=True)
class Measured:
    """A plane at two stage positions by one method."""

    calibration: Calibration
    error: np.ndarray  # (heights, rows, cols) vertical, mm
    true: np.ndarray  # (heights,) mm
    predicted: np.ndarray  # (heights,) mm, what the stage does to the paper's method


@pytest.fixture(scope="module")
def measured(tmp_path_factory) -> dict[str, Measured]:
    folder = tmp_path_factory.mktemp("methods")
    rig, bench = greenough.twin.open("twin", SMALL, run="calibration")
    with record(rig, folder / "recording.h5") as recorded:
        calibrate_by_methods(recorded, {"paper": folder / "recorded.h5"}, "calibration")
    outs = {method: folder / f"{method}.h5" for method in METHODS}
    with open_recording(folder / "recording.h5") as replayed:
        calibrations = calibrate_by_methods(replayed, outs, "calibration")
    assert {path.stem for path in folder.iterdir()} == {"recording", "recorded", *METHODS}
    heights = [Calibration.load(folder / f"{name}.h5").phase_height.coefficients for name in ("recorded", "paper")]
    assert np.array_equal(*heights, equal_nan=True)
    rig, bench = greenough.twin.open("twin", SMALL, run="measurement")
    phases, motions = [], []
    with rig:
        rig.operator.place(Placement("plane"))
        auto_exposure(rig)
        fringes = calibrations["bundle"].fringes
        for height in HEIGHTS:
            rig.stage.move_to_mm(height)
            phases.append(decode(rig.capture(fringes.patterns(*rig.projector.shape)), fringes, rig.camera.noise))
            motions.append(bench.world_from_part)
        readings = plane_heights(rig)
    results = {}
    for method in outs:
        calibration = Calibration.load(outs[method])
        errors = []
        for phase_map, world_from_part in zip(phases, motions, strict=True):
            normal, origin = world_from_part[:3, 2], world_from_part[:3, 3]
            errors.append((reconstruct(phase_map, calibration).xyz - origin) @ normal / normal[2])
        true = np.array([motion[2, 3] for motion in motions])
        predicted = systematic_error(bench, readings, true).mean(axis=1)
        results[method] = Measured(calibration, np.array(errors), true, predicted)
    return results


def step_error(measured: Measured) -> float:
    low, high = np.nanmean(measured.error, axis=(1, 2))
    return high - low


def test_the_papers_method_repeats_what_the_stage_did(measured):
    paper = measured["paper"]
    predicted = paper.predicted[1] - paper.predicted[0]
    assert abs(predicted) > 5e-3
    assert step_error(paper) == pytest.approx(predicted, abs=1e-3)


def test_the_papers_errors_of_height_take_x_and_y_along_on_the_rays(measured):
    """With this stage nothing else makes x and y err together with z."""
    calibration = measured["paper"].calibration
    covariance = calibration.uncertainty.covariance(np.array([[320.0, 240.0]]), np.array([1.25]))[0]
    expected = calibration.rays.slope[240, 320] * covariance[2, 2]
    assert np.abs(expected).max() > 0.05 * covariance[2, 2]
    np.testing.assert_allclose(covariance[:2, 2], expected, atol=0.01 * covariance[2, 2])


@pytest.mark.parametrize(("method", "largest_sd"), [("bundle", 0.8e-3), ("stage-free", 1.5e-3)])
def test_methods_that_believe_the_board_know_the_step_as_well_as_they_say(measured, method, largest_sd):
    """In the middle of the field, and far better than the stage. Four standard deviations: false alarm 1 in 16 000."""
    result = measured[method]
    ends = np.array([[0.0, 0.0, height] for height in result.true])
    covariance = result.calibration.instrument.point_covariance(ends)
    sd = np.sqrt(covariance[5, 5] + covariance[2, 2] - 2 * covariance[2, 5])
    assert sd < largest_sd
    assert abs(step_error(result)) < 4 * sd
    assert abs(step_error(result)) < 0.3 * abs(step_error(measured["paper"]))


def test_the_bundle_finds_the_stages_errors(measured):
    assert measured["bundle"].calibration.figures["stage_departure_um"] == pytest.approx(10, rel=0.7)
    assert measured["bundle"].calibration.figures["plane_residual_um"] < 0.5
    assert measured["paper"].calibration.figures["plane_residual_um"] > 5


def test_triangulation_does_not_believe_the_stage(measured):
    """Its covariance knows nothing of the board's bow and of the lenses, so that it foretells less than the error."""
    assert abs(step_error(measured["triangulation"])) < 0.3 * abs(step_error(measured["paper"]))


def test_methods_without_planes_are_valid_where_spots_were(measured):
    """Both saw the same spots; beyond them by half a pitch, they say nothing."""
    free, plain = (measured[method].calibration for method in ("stage-free", "triangulation"))
    shares = free.phase_height.valid, plain.phase_height.valid
    assert (shares[0] & shares[1]).sum() > 0.98 * (shares[0] | shares[1]).sum()
    assert free.figures["z_high_mm"] < 1.35
    assert np.nanmax(free.phase_height.z_range) == pytest.approx(free.figures["z_high_mm"] + 0.325, abs=0.01)


def test_paper_and_bundle_measure_the_same_pixels(measured):
    seen = [np.isfinite(measured[method].error) for method in ("paper", "bundle")]
    assert seen[0].mean() > 0.3
    assert (seen[0] & seen[1]).sum() > 0.97 * (seen[0] | seen[1]).sum()


def test_the_bundle_holds_where_the_boards_rim_passed_by(measured):
    """Pixels that did not see all planes know less by the paper's method; the bundle's model is as good there."""
    relation = measured["bundle"].calibration.phase_height
    assert np.ptp(relation.z_range[relation.valid], axis=0).max() < 1e-4
    more = np.isfinite(measured["bundle"].error) & ~np.isfinite(measured["paper"].error)
    rest = np.isfinite(measured["bundle"].error) & ~more
    assert more.sum() > 50
    rms = [np.sqrt(np.mean(measured["bundle"].error[where] ** 2)) for where in (more, rest)]
    assert rms[0] < 1.5 * rms[1]


def test_reprojection_falls_to_the_spots_noise_when_their_places_are_estimated(measured):
    rmse = {method: result.calibration.figures["reprojection_rmse_u_px"] for method, result in measured.items()}
    assert rmse["bundle"] < 0.8 * rmse["paper"]


def test_residuals_are_kept_for_every_posture_and_plane(measured):
    for method, result in measured.items():
        residuals = result.calibration.residuals
        assert residuals.spots_px.shape == residuals.centres_px.shape == (12, 99, 2)
        with_planes = METHODS[method].needs_planes
        assert residuals.planes_um.shape == (10 * with_planes, 30, 40)
        assert np.isfinite(residuals.spot_phases_rad).any() == METHODS[method].needs_spot_phases
        if with_planes:
            assert np.array_equal(np.isfinite(residuals.pixels_um), result.calibration.phase_height.valid)
