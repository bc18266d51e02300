"""Claims about planes, on points whose errors are known."""

import numpy as np
import pytest

from greenough.pipeline.reconstruct import PointMap
from greenough.twin.validation.planes import (
    PAPER_LINE,
    PlaneNoise,
    Volume,
    _block_means,
    noise_claims,
    paper_line,
    vertical_error,
    volume_claims,
)


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


def test_the_papers_line_lies_at_the_same_share_of_any_picture():
    assert paper_line(960) == PAPER_LINE == 330
    assert paper_line(240) == 82


def test_noise_rows_state_the_scatter_and_predict_it_on_an_ideal_stage(analytic):
    """30 000 normal deviates: their RMS is within 2 %, at 1 in 10^6, of the standard deviation."""
    generator = np.random.default_rng(2)
    raw, two, filtered = (generator.normal(0, sigma, (150, 200)) for sigma in (2e-3, 1.4e-3, 0.6e-3))
    raw[:2, :5] = np.nan
    rows = {row.claim: row for row in noise_claims(analytic(), PlaneNoise(raw, two, filtered, 2e-3, 0.6e-3))}
    assert set(rows) == {
        "plane_rmse_raw", "plane_rmse_two_exposures", "plane_rmse_filtered", "plane_within_5um", "plane_line_noise",
    }  # fmt: skip
    for name, sigma_um in (("raw", 2.0), ("two_exposures", 1.4), ("filtered", 0.6)):
        assert rows[f"plane_rmse_{name}"].measured == pytest.approx(sigma_um, rel=0.02)
    assert rows["plane_rmse_raw"].n == 150 * 200 - 10
    assert rows["plane_within_5um"].measured == pytest.approx(0.98758, abs=4e-3)  # erf(5 / 2 / sqrt 2)
    assert rows["plane_line_noise"].n == 200
    # The calibration's own noise adds 0.27 of the single exposure's in quadrature.
    assert rows["plane_rmse_raw"].predicted == pytest.approx(2 * np.hypot(1, 0.27), rel=1e-6)
    assert rows["plane_rmse_filtered"].predicted == pytest.approx(np.hypot(0.6, 0.27 * 2), rel=1e-6)
    assert [rows[f"plane_rmse_{name}"].holds for name in ("raw", "two_exposures", "filtered")] == [False, False, True]


def test_systematic_rows_average_noise_away_and_leave_height_and_tilt_aside(analytic):
    """Blocks of 256 normal deviates of 1.6 um: their means have 0.1 um, and an RMS of many of them is within 5 %."""
    rng = np.random.default_rng(4)
    xyz = field((960, 1280))
    volume = Volume()
    for height, bump in ((-1.0, 0.0), (0.0, 0.4e-3), (1.0, 0.0)):
        wave = bump * np.sqrt(2) * np.sin(2 * np.pi * xyz[..., 0])  # 1 mm long, its RMS is the bump
        error = 3e-3 + 1e-3 * xyz[..., 0] - 0.5e-3 * xyz[..., 1] + wave + rng.normal(0, 1.6e-3, wave.shape)
        error[:100] = np.nan
        volume.blocks.append(_block_means(xyz[..., :2], error))
        volume.errors.append(error[np.isfinite(error)])
        volume.spans.append((np.array([-4.0, -3.0]), np.array([4.0, 3.0])))
        volume.heights.append(height)
        volume.noise.append(1.6e-3)
        volume.filtered_noise.append(0.3e-3)
    rows = {row.claim: row for row in volume_claims(analytic(), volume)}
    # 54 of 60 rows of blocks are left; the tilt at the middle of what they measure, y = -0.30 mm, is 0.15 um.
    assert rows["depth_origin"].measured == pytest.approx(3.15, abs=0.02)
    assert rows["depth_systematic_rms"].measured == pytest.approx(np.hypot(0.1, 0.4 / np.sqrt(3)), rel=0.08)
    assert rows["depth_systematic_rms"].holds
    assert rows["depth_systematic_p99"].measured < 1.5
    assert rows["depth_systematic_rms"].n == 3 * 54 * 80
