import numpy as np
import pytest

from greenough.pipeline.homographies import start_camera

SHAPE = (960, 1280)
FOCAL = 22683.0


@pytest.fixture
def pictured(poses, spot_board):
    """Spots of an ideal camera in its postures, and these."""

    def one(seed: int, noise_px: float = 0.0):
        rng = np.random.default_rng(seed)
        camera_from_board = np.array(poses(rng))
        spots = np.column_stack([spot_board.centres(), np.zeros(99)])
        xyz = spots @ camera_from_board[:, :3, :3].swapaxes(1, 2) + camera_from_board[:, None, :3, 3]
        centres = FOCAL * xyz[..., :2] / xyz[..., 2:] + [639.5, 479.5]
        return centres + rng.normal(0.0, noise_px, centres.shape), camera_from_board

    return one


def test_an_ideal_camera_is_found_without_any_adjustment(pictured, spot_board):
    centres, camera_from_board = pictured(1)
    camera, poses = start_camera(centres, np.ones((16, 99), dtype=bool), spot_board.centres(), SHAPE)
    assert camera.fx == camera.fy == pytest.approx(FOCAL, rel=1e-6)
    np.testing.assert_allclose(poses[:, :3, :3], camera_from_board[:, :3, :3], atol=1e-6)
    np.testing.assert_allclose(poses[:, :3, 3], camera_from_board[:, :3, 3], rtol=1e-5, atol=1e-5)


def test_print_errors_leave_a_start_within_a_tenth(pictured, spot_board):
    """0.06 px; unseen spots may be anything."""
    for seed in range(10):
        centres, _ = pictured(seed, noise_px=0.06)
        seen = np.random.default_rng(seed).random((16, 99)) < 0.8
        centres[~seen] = 1e9
        camera, poses = start_camera(centres, seen, spot_board.centres(), SHAPE)
        assert camera.fx == pytest.approx(FOCAL, rel=0.1)
        assert (np.linalg.det(poses[:, :3, :3]) > 0).all()
        assert (poses[:, 2, 3] > 0).all()
