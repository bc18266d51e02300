"""Claims about surfaces as the page carries them: nothing is lost beyond the stated steps, and files are bounded."""

import base64
import json
import zlib

import numpy as np
import pytest

from greenough.instrument.errors import InputError
from greenough.pipeline.point_cloud import PointCloud
from greenough.pipeline.report import surface_view
from greenough.pipeline.report.surface_view import SurfaceView, error_layer, payload, view_of_cloud


def decoded(layer: dict, rows: int, cols: int) -> np.ndarray:
    """What the page's script makes of a layer, written anew from the format."""
    low, high = np.frombuffer(zlib.decompress(base64.b64decode(layer["data"])), np.uint8).reshape(2, -1).astype(int)
    zigzag = low + 256 * high
    codes = np.cumsum(np.where(zigzag % 2, -(zigzag // 2) - 1, zigzag // 2)) % 65536
    return np.where(codes > 0, layer["zero"] + layer["step"] * (codes - 1.0), np.nan).reshape(rows, cols)


def places(shown: dict, z: np.ndarray) -> np.ndarray:
    """x and y (rows, cols, 2) as the script evaluates them."""
    v, u = np.mgrid[: shown["rows"], : shown["cols"]].astype(float)
    n, m = 2 * u / (shown["cols"] - 1) - 1, 2 * v / (shown["rows"] - 1) - 1
    h = (z - shown["z_middle"]) / shown["z_half"]
    terms = [np.ones_like(n), n, m, n * n, n * m, m * m, h, h * n, h * m, n**3, n * n * m, n * m * m, m**3]
    return np.stack([sum(c * t for c, t in zip(shown[a], terms, strict=True)) for a in "xy"], axis=-1)


def camera_points(rows: int = 96, cols: int = 128) -> np.ndarray:
    """A rough surface as a camera with distortion and diverging rays sees it, with voids, mm."""
    rng = np.random.default_rng(2)
    v, u = np.mgrid[:rows, :cols].astype(float)
    x, y = (u - cols / 2) * 0.06, -(v - rows / 2) * 0.06
    bent = 1 + 2e-4 * (x * x + y * y)
    z = rng.normal(0, 2e-3, x.shape) + 0.3 * np.sin(x)
    xyz = np.stack([x * bent * (1 - z / 200) + 0.1 * z, y * bent * (1 - z / 200), z], axis=-1)
    xyz[rng.random(x.shape) < 0.1] = np.nan
    xyz[:3] = np.nan
    return xyz


def test_heights_and_errors_come_back_within_half_a_step():
    xyz = camera_points()
    error = np.where(np.isfinite(xyz[..., 2]), 1e3 * xyz[..., 2], np.nan)
    shown = json.loads(json.dumps(payload(SurfaceView("s", xyz, [error_layer(error)])), allow_nan=False))
    assert (shown["rows"], shown["row0"], shown["col0"]) == (93, 3, 0)
    height, coloured = (decoded(layer, 93, 128) for layer in shown["layers"])
    assert shown["layers"][0]["step"] == 1e-4
    np.testing.assert_allclose(height, xyz[3:, :, 2], atol=0.5001e-4)  # NaN where it was
    np.testing.assert_allclose(coloured, error[3:], atol=0.5001 * shown["layers"][1]["step"])


def test_places_follow_a_camera_with_distortion_within_a_tenth_of_a_micrometre():
    xyz = camera_points()[3:]
    found = places(payload(SurfaceView("s", xyz)), xyz[..., 2])
    assert np.nanmax(np.abs(found - xyz[..., :2])) < 1e-4


def test_a_wild_value_does_not_make_the_others_coarse():
    error = np.random.default_rng(1).normal(0, 1.0, (96, 128))
    error[50, 50] = 1e7
    shown = payload(SurfaceView("s", camera_points(), [error_layer(error)]))
    layer = shown["layers"][1]
    assert layer["step"] < 0.05
    back = decoded(layer, shown["rows"], shown["cols"])
    np.testing.assert_allclose(back[:40], error[3:43], atol=0.03)


def test_a_grid_with_too_many_points_is_thinned_and_says_so(monkeypatch):
    monkeypatch.setattr(surface_view, "MOST_POINTS", 4000)
    shown = payload(SurfaceView("s", camera_points(), note="As it is."))
    assert shown["rows"] * shown["cols"] <= 4000
    assert shown["pixel_step"] == 2
    assert shown["note"] == "As it is. Shown is one pixel of 2 x 2."


def test_a_cloud_without_pixels_is_laid_on_a_grid_of_x_and_y():
    rng = np.random.default_rng(3)
    xyz = rng.uniform([0, 0, 0], [4, 2, 0], (20_000, 3))
    xyz[:, 2] = 0.1 * xyz[:, 0] - 0.2 * xyz[:, 1]
    view = view_of_cloud("s", PointCloud(xyz))
    rows, cols = view.xyz.shape[:2]
    assert cols == pytest.approx(2 * rows, rel=0.05)
    x, y, z = np.moveaxis(view.xyz, -1, 0)
    np.testing.assert_allclose(z, 0.1 * x - 0.2 * y)
    assert np.nanmean(np.diff(x, axis=1)) > 0
    assert np.nanmean(np.diff(y, axis=0)) < 0  # the first row is at the top
    assert "know no pixels" in view.note


@pytest.mark.parametrize("claimed", [[0, 2**31 - 1], [-(2**31), 2**31 - 1], [0, 40_000]])
def test_pixels_that_claim_a_huge_camera_do_not_fill_the_memory(claimed):
    pixels = np.zeros((100, 2), np.int32)
    pixels[:2, 0] = pixels[:2, 1] = claimed
    view = view_of_cloud("s", PointCloud(np.random.default_rng(1).random((100, 3)), pixels))
    assert view.xyz.size < 1e6


def test_points_too_far_apart_to_be_seen_are_refused():
    xyz = np.array([[0.0, 0, 0], [1e300, 0, 0]])
    with pytest.raises(InputError, match="1e\\+300 mm apart"):
        view_of_cloud("s", PointCloud(xyz))


@pytest.mark.parametrize("xyz", [np.zeros((1, 3)), np.column_stack([np.arange(9.0), np.zeros(9), np.zeros(9)])])
def test_a_point_and_a_line_have_a_payload(xyz):
    shown = payload(view_of_cloud("s", PointCloud(xyz)))
    json.dumps(shown, allow_nan=False)
    assert np.isfinite(decoded(shown["layers"][0], shown["rows"], shown["cols"])).sum() == len(xyz)
