from dataclasses import dataclass

import numpy as np
import pytest
from scipy import stats

from greenough.instrument.errors import InputError
from greenough.pipeline.camera_calibration import CameraCalibration, calibrate_camera
from greenough.pipeline.spots import detect_spots

SHAPE = (960, 1280)
PX_PER_MM = 101.0
VOLUME = np.stack(np.meshgrid([-4.0, -2.0, 0.0, 2.0, 4.0], [-3.0, 0.0, 3.0], [-1.5, 0.0, 1.5]), axis=-1).reshape(-1, 3)


@dataclass(frozen=True)
class Draw:
    """One simulated calibration and where the points of the volume are really imaged."""

    calibration: CameraCalibration
    truth_px: np.ndarray  # (points, 2)

    @property
    def errors_px(self) -> np.ndarray:
        return self.calibration.project(VOLUME) - self.truth_px


@pytest.fixture(scope="module")
def draw(imaged_circles, imaged_points, poses, spot_board):
    """Calibrate on conics of imaged points, with print errors and noise drawn anew."""

    def one(seed: int, print_sd_mm: float = 0.0, noise_px: float = 0.0, lost: float = 0.0) -> Draw:
        rng = np.random.default_rng(seed)
        transforms = poses(rng)
        printed = spot_board.centres() + rng.normal(0.0, print_sd_mm, (99, 2))
        observations = [imaged_circles(printed, spot_board.diameters() / 2, pose) for pose in transforms]
        observations = [centres + rng.normal(0.0, noise_px, (99, 2)) for centres in observations]
        for centres in observations:
            centres[rng.random(99) < lost] = np.nan
        calibration = calibrate_camera(observations, spot_board, SHAPE, reference=15)
        return Draw(calibration, imaged_points(best_fit(spot_board.centres(), printed), transforms[15]))

    return one


def best_fit(nominal: np.ndarray, printed: np.ndarray) -> np.ndarray:
    """VOLUME, given in the frame of the nominal spots best-fitted to the printed ones, in the printed board's frame."""
    u, _, vt = np.linalg.svd((nominal - nominal.mean(0)).T @ (printed - printed.mean(0)))
    turn = (u @ np.diag([1.0, np.linalg.det(u @ vt)]) @ vt).T
    placed = VOLUME.copy()
    placed[:, :2] = (VOLUME[:, :2] - nominal.mean(0)) @ turn.T + printed.mean(0)
    return placed


def test_a_perfect_board_gives_the_camera_back(draw):
    """Over the whole volume, not f alone: f and the distance trade against each other."""
    result = draw(1)
    assert np.abs(result.errors_px).max() < 1e-3
    assert result.calibration.reprojection_rmse_px.max() < 1e-4
    assert result.calibration.camera.skew_angle_deg == pytest.approx(90.0 + np.degrees(1.0 / 22683.0), abs=1e-4)


def test_spots_that_were_not_seen_are_left_out(draw):
    result = draw(2, lost=0.25)
    assert np.abs(result.errors_px).max() < 1e-3
    assert np.isnan(result.calibration.residuals_px[..., 0]).mean() == pytest.approx(0.25, abs=0.05)


def test_reprojection_error_of_a_nominal_board_is_its_print_error(draw):
    """0.6 µm are 0.0606 px. 99 spots per axis, three to six degrees of freedom absorbed: 4 sd are 29 %."""
    result = draw(3, print_sd_mm=0.6e-3, noise_px=0.007).calibration
    assert result.reprojection_rmse_px == pytest.approx(np.full(2, 0.6e-3 * PX_PER_MM), rel=0.29)
    assert result.print_sd_mm == pytest.approx(0.6e-3, rel=0.2)
    assert result.noise_sd_px == pytest.approx(0.007, rel=0.35)


def test_print_and_noise_are_told_apart(draw):
    result = draw(4, noise_px=0.02).calibration
    assert result.noise_sd_px == pytest.approx(0.02, rel=4 / np.sqrt(2 * 3000))
    assert result.print_sd_mm < 0.1e-3


@pytest.mark.slow
@pytest.mark.parametrize(("print_sd_mm", "noise_px"), [(0.6e-3, 0.007), (0.0, 0.02)])
def test_covariance_of_projected_points_predicts_their_errors(draw, print_sd_mm, noise_px):
    """24 calibrations, each with its own postures, print and noise, each judged at one point of the volume.

    The sum of squared normalised errors is chi-square with 48 degrees of freedom; false alarm 1 in 1000, widened by
    5 % because the print's and the noise's size are themselves estimated.
    """
    rng = np.random.default_rng(9)
    total = 0.0
    for seed in range(24):
        result = draw(100 + seed, print_sd_mm, noise_px)
        point = rng.integers(len(VOLUME))
        error = result.errors_px[point]
        covariance = result.calibration.projected_covariance(VOLUME[[point]])[0]
        total += error @ np.linalg.solve(covariance, error)
    low, high = stats.chi2.ppf([0.0005, 0.9995], 48)
    assert 0.95 * low < total < 1.05 * high


@pytest.mark.slow
def test_pictures_give_a_calibration_as_good_as_predicted(paint, poses, imaged_points, spot_board):
    """Painted pictures through detection and calibration; the largest of 90 correlated normalised errors is below 5."""
    rng = np.random.default_rng(21)
    transforms = poses(rng, 8)
    printed = spot_board.centres() + rng.normal(0.0, 0.6e-3, (99, 2))
    pictures = [paint(spot_board, pose, rng, centres=printed, noise_dn=0.5).picture for pose in transforms]
    observations = [detect_spots(picture, spot_board) for picture in pictures]
    calibration = calibrate_camera(observations, spot_board, SHAPE, reference=7)
    assert calibration.reprojection_rmse_px == pytest.approx(np.full(2, 0.6e-3 * PX_PER_MM), rel=0.29)
    errors = calibration.project(VOLUME) - imaged_points(best_fit(spot_board.centres(), printed), transforms[7])
    variance = np.einsum("nii->ni", calibration.projected_covariance(VOLUME))
    assert np.abs(errors / np.sqrt(variance)).max() < 5.0


def test_the_world_is_the_board_of_the_reference_posture(draw):
    calibration = draw(5).calibration
    assert np.array_equal(calibration.camera_from_world, calibration.camera_from_board[15])
    assert calibration.camera_from_world[2, 2] < -0.9  # z up, towards the camera that looks down


def test_the_same_spots_give_the_same_bits(draw):
    first, second = (draw(5, print_sd_mm=0.6e-3, noise_px=0.007).calibration for _ in range(2))
    assert first.camera == second.camera
    assert np.array_equal(first.covariance, second.covariance)


@pytest.mark.parametrize("tilt_deg", [0.0, 15.0])
def test_parallel_postures_are_refused_by_name(pose, imaged_circles, spot_board, tilt_deg):
    """The same normal everywhere; only shifts and turns about it differ, with print errors and noise on top."""
    rng = np.random.default_rng(7)
    printed = spot_board.centres() + rng.normal(0.0, 0.6e-3, (99, 2))
    observations = []
    for turn in range(0, 360, 45):
        transform = pose(tilt_deg, 30.0, turn, tuple(rng.uniform(-0.7, 0.7, 2)))
        centres = imaged_circles(printed, spot_board.diameters() / 2, transform)
        observations.append(centres + rng.normal(0.0, 0.007, (99, 2)))
    names = [f"posture {k}" for k in range(8)]
    with pytest.raises(InputError, match=r"all 8 postures of the board are parallel .*posture 0, .*posture 7"):
        calibrate_camera(observations, spot_board, SHAPE, reference=0, names=names)


def test_small_but_different_tilts_are_enough(pose, imaged_circles, spot_board):
    transforms = [pose(3.0 + 0.6 * k, 50.0 * k, 90.0 * k, (0.0, 0.0)) for k in range(8)]
    observations = [imaged_circles(spot_board.centres(), spot_board.diameters() / 2, pose) for pose in transforms]
    calibration = calibrate_camera(observations, spot_board, SHAPE, reference=0)
    assert calibration.reprojection_rmse_px.max() < 1e-4


def test_too_few_postures_are_refused_by_name(poses, imaged_circles, spot_board):
    transforms = poses(np.random.default_rng(8), 5)
    observations = [imaged_circles(spot_board.centres(), spot_board.diameters() / 2, pose) for pose in transforms]
    with pytest.raises(InputError, match=r"from 5 postures of the board \(a, b, c, d, e\): at least 6"):
        calibrate_camera(observations, spot_board, SHAPE, reference=0, names=list("abcde"))


def test_a_posture_with_too_few_spots_is_named(poses, imaged_circles, spot_board):
    transforms = poses(np.random.default_rng(8), 7)
    observations = [imaged_circles(spot_board.centres(), spot_board.diameters() / 2, pose) for pose in transforms]
    observations[2][5:] = np.nan
    with pytest.raises(InputError, match=r"posture c \(5\): at least 12"):
        calibrate_camera(observations, spot_board, SHAPE, reference=0, names=list("abcdefg"))
