"""Claims about planes, on points whose errors are known."""

import numpy as np

from greenough.pipeline.reconstruct import PointMap
from greenough.twin.validation.planes import BLOCK_PX, blocks_of, half_measured, vertical_error, without_plane


def field(shape: tuple[int, int] = (96, 128)) -> np.ndarray:
    """Points (rows, cols, 3) on z = 0 over the field."""
    x, y = np.meshgrid(np.linspace(-4, 4, shape[1]), np.linspace(3, -3, shape[0]))
    return np.stack([x, y, np.zeros_like(x)], axis=-1)


def tilted(about_x: float, about_y: float, height: float) -> np.ndarray:
    cx, sx, cy, sy = np.cos(about_x), np.sin(about_x), np.cos(about_y), np.sin(about_y)
    motion = np.eye(4)
    motion[:3, :3] = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]]) @ np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    motion[:3, 3] = [0.3, -0.2, height]
    return motion


def test_vertical_error_is_the_height_above_the_plane_as_it_lies(analytic):
    motion = tilted(0.02, -0.3, 0.7)
    on_plane = field() @ motion[:3, :3].T + motion[:3, 3]
    error = np.random.default_rng(1).normal(0, 5e-3, on_plane.shape[:2])
    error[3, 4] = np.nan
    measured = on_plane + error[..., None] * [0, 0, 1]
    np.testing.assert_allclose(vertical_error(analytic(motion), PointMap(measured)), error, atol=1e-12)


def test_the_best_plane_takes_height_and_tilt_and_nothing_else(analytic):
    xyz = field()
    saddle = 1e-3 * xyz[..., 0] * xyz[..., 1]  # orthogonal to planes on this symmetric grid
    xyz[..., 2] = 0.3 - 0.02 * xyz[..., 0] + 0.01 * xyz[..., 1] + saddle
    xyz[:2, :] = np.nan
    xyz[-2:, :] = np.nan
    left = without_plane(analytic(), PointMap(xyz))
    np.testing.assert_allclose(left[2:-2], saddle[2:-2], atol=1e-12)
    assert np.isnan(left[:2]).all()


def test_blocks_are_squares_of_neighbours():
    image = np.arange(40 * 50.0).reshape(40, 50)
    blocks = blocks_of(image)
    assert blocks.shape == (2 * 3, BLOCK_PX**2)
    np.testing.assert_array_equal(blocks[4], image[16:32, 16:32].ravel())


def test_a_block_counts_from_half_its_pixels():
    blocks = np.ones((2, 256))
    blocks[0, :128] = np.nan
    blocks[1, :129] = np.nan
    assert half_measured(blocks).tolist() == [True, False]
