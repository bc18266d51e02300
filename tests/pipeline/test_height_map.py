"""A height map has the surface's heights where there is a surface, and voids where there is none."""

import numpy as np
import pytest

from greenough.instrument.errors import InputError
from greenough.pipeline import height_map as module
from greenough.pipeline.compare import Surface, vertical_errors
from greenough.pipeline.height_map import height_map
from greenough.pipeline.point_cloud import PointCloud
from greenough.pipeline.surface_mesh import surface_mesh

PITCH = 0.01


def cloud(height, rows=60, cols=80, turn_deg=7.0, void=None, jitter=0.0):
    """Points of a height function in the pixels of a camera that is turned against the world; y falls with the row."""
    rng = np.random.default_rng(5)
    row, col = np.mgrid[:rows, :cols] + jitter * rng.uniform(-0.5, 0.5, (2, rows, cols))
    a, b = PITCH * (col - cols / 2), -PITCH * (row - rows / 2)
    cosine, sine = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))
    x, y = cosine * a - sine * b, sine * a + cosine * b
    kept = np.ones((rows, cols), bool)
    if void is not None:
        kept[void] = False
    xyz = np.stack([x, y, np.broadcast_to(height(x, y), x.shape)], axis=-1)[kept]
    return PointCloud(xyz, np.argwhere(kept).astype(np.int32), facts={"sample": "test"})


def nodes(heights):
    """x and y of every node, (rows, cols) each."""
    rows, cols = heights.z.shape
    return np.meshgrid(heights.left + heights.pitch * np.arange(cols), heights.top - heights.pitch * np.arange(rows))


def bumps(x, y):
    return 0.05 * np.sin(9 * x) * np.cos(7 * y) + 0.02 * x


def test_a_plane_is_met_at_every_node_from_points_that_lie_anyhow():
    heights = height_map(cloud(lambda x, y: 0.3 * x - 0.2 * y + 0.1, jitter=0.5))
    x, y = nodes(heights)
    seen = ~heights.voids
    np.testing.assert_allclose(heights.z[seen], (0.3 * x - 0.2 * y + 0.1)[seen], atol=1e-12)
    assert heights.facts == {"sample": "test"}
    area = 58.5 * 78.5  # of the pixels' outline in squares, with and without half of the jitter
    assert abs(seen.sum() * heights.pitch**2 / PITCH**2 / area - 1) < 0.03


def test_columns_go_along_x_and_rows_go_down_in_y():
    heights = height_map(cloud(lambda x, y: np.exp(-((x - 0.2) ** 2 + (y - 0.12) ** 2) / 0.003), turn_deg=0.0))
    row, col = np.unravel_index(np.nanargmax(heights.z), heights.z.shape)
    x, y = nodes(heights)
    assert (x[row, col], y[row, col]) == pytest.approx((0.2, 0.12), abs=1e-9)
    assert row < heights.z.shape[0] / 2
    assert col > heights.z.shape[1] / 2
    assert heights.bottom == pytest.approx(y[-1, 0])


def test_heights_and_voids_are_those_that_a_ray_from_above_meets():
    points = cloud(bumps, void=np.s_[20:31, 30:41], jitter=0.8)
    heights = height_map(points, 0.004)
    x, y = nodes(heights)
    from_above = vertical_errors(
        np.stack([x, y, heights.z], axis=-1).reshape(-1, 3), Surface.of(surface_mesh(points))
    ).reshape(x.shape)
    seen = ~heights.voids
    np.testing.assert_allclose(from_above[seen], 0, atol=1e-9)
    below = np.stack([x, y, np.full_like(x, -1.0)], axis=-1).reshape(-1, 3)
    hit = np.isfinite(vertical_errors(below, Surface.of(surface_mesh(points)))).reshape(x.shape)
    assert np.count_nonzero(hit != seen) <= 3  # the ray tracer's single precision at the rims


def test_a_hole_between_pixels_is_a_hole_of_that_size():
    heights = height_map(cloud(bumps, void=np.s_[20:31, 30:41]))
    inner = heights.z[15:-15, 15:-15]
    assert np.isnan(inner).sum() == pytest.approx(12**2 - 2, abs=8)  # to the middle of the corners, which are cut


def test_a_step_stays_open_and_its_sides_keep_their_heights():
    heights = height_map(cloud(lambda x, y: 0.3 * (x > 0.005), turn_deg=0.0))
    across = heights.z[30]
    assert set(np.unique(across[np.isfinite(across)])) == {0.0, 0.3}


def test_under_an_overhang_the_uppermost_surface_counts():
    points = cloud(lambda x, y: 0.0 * x, turn_deg=0.0)
    u = points.pixels[:, 1]
    xyz = points.xyz.copy()
    # Seen from aside, columns 40 to 49 run back below what was there, and from there on again.
    xyz[:, 0] = PITCH * np.interp(u, [0, 40, 50, 79], [0, 40, 30, 59])
    xyz[:, 2] = np.interp(u, [0, 40, 50, 79], [0, 0, -0.1, -0.1])
    heights = height_map(PointCloud(xyz, points.pixels), PITCH)
    x, _ = nodes(heights)
    np.testing.assert_allclose(heights.z[:, x[0] < 0.395], 0, atol=1e-12)
    np.testing.assert_allclose(heights.z[:, x[0] > 0.405], -0.1, atol=1e-12)


def test_the_pitch_is_the_clouds_own_unless_it_is_said():
    assert height_map(cloud(bumps, turn_deg=33.0)).pitch == pytest.approx(PITCH, rel=1e-9)
    assert height_map(cloud(bumps), 0.02).pitch == 0.02


def test_maps_of_several_clouds_with_one_pitch_have_common_nodes():
    whole, part = cloud(bumps), cloud(bumps)
    part = PointCloud(part.xyz[: 40 * 80], part.pixels[: 40 * 80])
    one, other = height_map(whole, 0.013), height_map(part, 0.013)
    shift = np.array([other.left - one.left, other.top - one.top]) / 0.013
    np.testing.assert_allclose(shift, np.rint(shift), atol=1e-9)
    col, row = np.rint(shift * [1, -1]).astype(int)
    rows, cols = other.z.shape
    over = one.z[row : row + rows, col : col + cols]
    np.testing.assert_allclose(over[~other.voids], other.z[~other.voids], atol=1e-12)


@pytest.mark.parametrize("pitch", [0.0, -1.0, np.nan, np.inf, 1e300, 1.0, PITCH / 11])
def test_a_pitch_that_is_none_or_much_finer_than_the_pixels_or_larger_than_all_is_refused(pitch):
    with pytest.raises(InputError, match="pitch"):
        height_map(cloud(bumps), pitch)


def test_points_far_away_do_not_make_a_map_that_fills_the_memory():
    near = cloud(bumps)
    far = near.xyz + np.array([1e6, 1e6, 0]), near.pixels + np.array([0, 1000], np.int32)
    with pytest.raises(InputError, match="at most"):
        height_map(PointCloud(np.concatenate([near.xyz, far[0]]), np.concatenate([near.pixels, far[1]])))


@pytest.mark.parametrize("x_by_u", [0.0, 1e-7])
def test_points_on_a_line_as_seen_from_above_are_refused(x_by_u):
    v, u = np.mgrid[:30, :30]
    xyz = np.stack([x_by_u * u, PITCH * v, PITCH * u], axis=-1).reshape(-1, 3)
    with pytest.raises(InputError, match="height map"):
        height_map(PointCloud(xyz, np.stack([v, u], axis=-1).reshape(-1, 2).astype(np.int32)), PITCH)


def test_a_map_that_is_made_in_many_parts_is_the_same(monkeypatch):
    whole = height_map(cloud(bumps, jitter=0.5))
    monkeypatch.setattr(module, "_CHUNK", 50)
    np.testing.assert_array_equal(height_map(cloud(bumps, jitter=0.5)).z, whole.z)
