"""Camera and projector as plain pinholes with distortion, on simulated ones that are just that."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy import stats

from greenough.instrument.errors import InputError
from greenough.pipeline.bundle_data import SpotPhases
from greenough.pipeline.camera_calibration import calibrate_camera
from greenough.pipeline.spots import Spots
from greenough.pipeline.stereo_calibration import StereoCalibration, calibrate_stereo

SHAPE = (960, 1280)
SPOT_PX, SPOT_RAD, PRINT_MM = 0.007, 0.0015, 0.6e-3
X, Y, Z = np.meshgrid(np.linspace(-3, 3, 5), np.linspace(-2.4, 2.4, 5), [-1.0, 0.0, 1.0], indexing="ij")
VOLUME = np.stack([X, Y, Z], axis=-1).reshape(-1, 3)


def projected_phase(points):
    """Absolute phase (n,) of a projector that leans 6° the other way, turned by 1° about its axis, with distortion."""
    sine, cosine = np.sin(np.radians(6.0)), np.cos(np.radians(6.0))
    ray = points - 224.56 * np.array([-sine, 0.0, cosine])
    depth = -(ray @ [-sine, 0.0, cosine])
    across, down = (ray @ [cosine, 0.0, sine]) / depth, ray[..., 1] / depth
    turn = np.radians(1.0)
    x, y = across * np.cos(turn) - down * np.sin(turn), across * np.sin(turn) + down * np.cos(turn)
    distorted = x * (1 - 3.0 * (x * x + y * y)) + 2 * 0.01 * x * y + 0.02 * (3 * x * x + y * y)
    return 2 * np.pi / 12 * (303.5 + 56.07 * 224.56 * distorted)


@dataclass(frozen=True)
class Observed:
    """Spots and phases, as `calibrate_stereo` takes them, and the camera's pose over the flat board."""

    spots: tuple[Spots, ...]
    phases: tuple[SpotPhases, ...]
    camera_from_table: np.ndarray


@pytest.fixture(scope="module")
def observe(imaged_points, imaged_circles, poses, spot_board):
    def one(seed: int, noise: float = 1.0, postures: int = 10) -> Observed:
        rng = np.random.default_rng(seed)
        transforms = poses(rng, postures)
        nominal = spot_board.centres()
        printed = nominal + noise * without_motion(rng.normal(0.0, PRINT_MM, nominal.shape), nominal)
        spots, phases = [], []
        for pose in transforms:
            table_from_board = np.linalg.inv(transforms[-1]) @ pose

            def phase_at(xy, table_from_board=table_from_board):
                flat = np.column_stack([xy, np.zeros(len(xy))])
                return projected_phase(flat @ table_from_board[:3, :3].T + table_from_board[:3, 3])

            circles = np.column_stack([printed, np.zeros(len(printed))])
            found = imaged_circles(circles, spot_board.diameters() / 2, pose)
            found = found + noise * rng.normal(0.0, SPOT_PX, found.shape)
            along, rise = [], []
            middle = imaged_points(circles, pose)
            for step in 0.01 * np.eye(2):
                moved = np.column_stack([printed + step, np.zeros(len(printed))])
                along.append(imaged_points(moved, pose) - middle)
                rise.append(phase_at(printed + step) - phase_at(printed))
            gradient = np.linalg.solve(np.stack(along, axis=1), np.stack(rise, axis=-1)[..., None])[..., 0]
            measured = phase_at(printed) + np.sum(gradient * (found - middle), axis=1)
            measured = measured + noise * rng.normal(0.0, SPOT_RAD, len(measured))
            sd = np.full(len(nominal), 0.5 * noise)
            spots.append(Spots(found, np.full_like(found, 9.0), sd * SPOT_PX))
            phases.append(SpotPhases(measured, gradient, sd * SPOT_RAD))
        return Observed(tuple(spots), tuple(phases), transforms[-1])

    return one


def without_motion(errors, nominal):
    """Print errors that neither shift, turn nor stretch the grid: the frame and the scale are the nominal spots'."""
    x, y = nominal.T
    motions = np.stack([np.stack(pair, axis=-1).ravel() for pair in ((1 + 0 * x, 0 * x), (0 * x, 1 + 0 * x), (-y, x))])
    motions = np.vstack([motions, nominal.ravel()])
    motions /= np.linalg.norm(motions, axis=1, keepdims=True)
    return errors - (motions.T @ (motions @ errors.ravel())).reshape(errors.shape)


def solve(observed: Observed, board) -> StereoCalibration:
    camera = calibrate_camera(observed.spots, board, SHAPE, reference=len(observed.spots) - 1)
    return calibrate_stereo(observed.spots, observed.phases, camera, board)


def errors_of(stereo: StereoCalibration, observed: Observed, imaged_points, points=VOLUME) -> np.ndarray:
    """Error (n, 3) in mm of points, to first order in what the model misses of pixel and phase."""
    model = stereo.instrument
    pixel, pixel_by_point, _ = model.camera.linearise(points)
    phase, phase_by_point, _ = model.projector.linearise(points)
    true_pixel, true_phase = imaged_points(points, observed.camera_from_table), projected_phase(points)
    slopes = np.concatenate([pixel_by_point, phase_by_point[:, None]], axis=1)
    return np.linalg.solve(slopes, np.column_stack([true_pixel - pixel, true_phase - phase])[..., None])[..., 0]


def test_ideal_lenses_are_found_exactly(observe, spot_board, imaged_points):
    """Without noise and print errors; what is left comes from the weak prior and from gradients over 10 µm."""
    observed = observe(1, noise=0.0)
    stereo = solve(observed, spot_board)
    assert np.abs(errors_of(stereo, observed, imaged_points)).max() < 20e-6
    assert np.abs(stereo.residuals_rad).max() < 2e-4


@pytest.mark.slow
def test_covariance_predicts_the_errors_of_points(observe, spot_board, imaged_points):
    """5 calibrations, each at a point: chi-square with 15 degrees of freedom; false alarm 1 in 1000."""
    rng, total = np.random.default_rng(3), 0.0
    for seed in range(5):
        observed = observe(seed)
        stereo = solve(observed, spot_board)
        point = VOLUME[[rng.integers(len(VOLUME))]]
        error = errors_of(stereo, observed, imaged_points, point)[0]
        total += error @ np.linalg.solve(stereo.instrument.point_covariance(point), error)
    low, high = stats.chi2.ppf([0.0005, 0.9995], 15)
    assert low < total < high


def test_heights_need_a_camera_that_the_phases_have_refined(observe, spot_board, imaged_points):
    """With the camera as its own calibration left it, beside the same projector, the lean that it errs by is a slope of
    all heights."""
    for seed in range(2):
        observed = observe(seed)
        camera = calibrate_camera(observed.spots, spot_board, SHAPE, reference=9)
        stereo = calibrate_stereo(observed.spots, observed.phases, camera, spot_board)
        path = replace(stereo.instrument.camera, camera=camera.camera, camera_from_world=camera.camera_from_world)
        alone = replace(stereo, instrument=replace(stereo.instrument, camera=path))
        refined, unrefined = (np.std(errors_of(each, observed, imaged_points)[:, 2]) for each in (stereo, alone))
        assert refined < 0.3 * unrefined


def test_wrong_phases_are_left_out(observe, spot_board, imaged_points):
    observed = observe(4)
    before = errors_of(solve(observed, spot_board), observed, imaged_points)
    observed.phases[3].phase_rad[40] += 2 * np.pi
    observed.phases[7].phase_rad[5] -= 0.3
    stereo = solve(observed, spot_board)
    assert np.isnan(stereo.residuals_rad[[3, 7], [40, 5]]).all()
    assert stereo.outliers <= 3  # five standard deviations: one more in 2000 such calibrations
    assert np.abs(errors_of(stereo, observed, imaged_points) - before).max() < 0.1e-3


def test_phases_of_one_posture_do_not_determine_a_projector(observe, spot_board):
    observed = observe(5)
    for measured in observed.phases[:-1]:
        measured.phase_rad[:], measured.sigma_rad[:] = np.nan, np.nan
    with pytest.raises(InputError, match="do not determine the projector"):
        solve(observed, spot_board)
