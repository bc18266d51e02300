"""Claims about boards: a posture of another print, or of another size, is named; noise names none."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from greenough.pipeline.camera_calibration import calibrate_camera
from greenough.pipeline.diagnosis.boards import check_boards, check_scales, prints_of
from greenough.pipeline.diagnosis.finding import Yardstick

SCALE = Yardstick(163.0, 0.5)
SHAPE = (480, 640)
NAMES = [*(f"{k:02d}" for k in range(7)), "flat"]
INTRINSICS = (11341.5, 11341.5, 0.0, 319.5, 239.5, 0.0, 0.0, 0.0, 0.0)


@pytest.fixture(scope="module")
def camera(spot_board, imaged_circles):
    """Calibrates from centres of spots (postures, spots, 2) that were printed at given places."""

    def made(printed, noise_px=0.005, seed=1):
        rng = np.random.default_rng(seed)
        centres = []
        for k, places in enumerate(printed):
            pose = np.eye(4)
            axis = np.array([np.cos(2.4 * k), np.sin(2.4 * k), 0])
            tilt = 0.0 if k == len(printed) - 1 else 9.0 + k
            turn = Rotation.from_rotvec(np.radians(tilt) * axis) * Rotation.from_euler("z", 37.0 * k, degrees=True)
            pose[:3, :3] = np.diag([1.0, -1.0, -1.0]) @ turn.as_matrix()
            pose[:3, 3] = [0.1 * k, -0.05 * k, 224.56]
            seen = imaged_circles(places, spot_board.diameters() / 2, pose, INTRINSICS)
            centres.append(seen + rng.normal(0, noise_px, seen.shape))
        return calibrate_camera(tuple(centres), spot_board, SHAPE, len(printed) - 1, NAMES)

    return made


def printed(board, seed, sd_mm=6e-4):
    return board.centres() + np.random.default_rng(seed).normal(0, sd_mm, board.centres().shape)


def test_a_posture_with_another_print_is_named(camera, spot_board):
    for seed in range(5):
        one, other = printed(spot_board, [seed, 1]), printed(spot_board, [seed, 2])
        boards = [one] * 8
        boards[seed] = other
        (finding,) = check_boards(camera(boards, seed=seed), spot_board, NAMES, SCALE)
        assert finding.where == f"posture {seed:02d}"
        assert finding.effect_um == pytest.approx(0.85, abs=0.25)  # two prints of 0.6 µm apart


@pytest.mark.slow
@pytest.mark.parametrize("noise_px", [0.005, 0.02, 0.1])
def test_one_board_in_all_postures_is_no_finding(camera, spot_board, noise_px):
    for seed in range(5):
        boards = [printed(spot_board, seed)] * 8
        assert check_boards(camera(boards, noise_px, seed), spot_board, NAMES, SCALE) == []


def test_residuals_on_the_board_are_the_print_whichever_way_it_lies(camera, spot_board):
    places = printed(spot_board, 3)
    residuals = prints_of(camera([places] * 8, noise_px=1e-4), spot_board).residuals_um
    made = 1e3 * (places - spot_board.centres())
    for own in residuals:
        left = own - made
        design = np.column_stack([np.ones(len(left)), spot_board.centres()])
        left -= design @ np.linalg.lstsq(design, left, rcond=None)[0]  # pose and scale take what is affine
        assert np.sqrt(np.mean(left**2)) < 0.2 * np.std(made)  # and the lens's distortion a little more


def radial(ppm):
    """A bundle's residuals in which each posture has so much of scale."""
    rng = np.random.default_rng(2)
    centres = rng.uniform(50, 430, (len(ppm), 99, 2))
    arms = centres - centres.mean(axis=1, keepdims=True)
    residuals = 1e-6 * np.array(ppm)[:, None, None] * arms + rng.normal(0, 0.005, centres.shape)
    board = SimpleNamespace(pitch_mm=0.65, rows=9, cols=11)
    return SimpleNamespace(board=board, residuals=SimpleNamespace(spots_px=residuals, centres_px=centres))


def test_a_larger_board_in_one_posture_is_named():
    (finding,) = check_scales(radial([0, 0, 0, 1000, 0, 0, 0, 0]), NAMES, SCALE)
    assert finding.where == "posture 03"
    assert finding.evidence["scale_departure_ppm"] == pytest.approx(1000, rel=0.1)
    assert check_scales(radial([10, -20, 5, 30, 0, -10, 15, 0]), NAMES, SCALE) == []
