"""Claims about maps: the colours are those of the values, void is void, and axes belong to the camera's pixels."""

import base64
import io
import re

import numpy as np
from matplotlib import colormaps
from PIL import Image

from greenough.pipeline.report import colours
from greenough.pipeline.report.map_panels import map_panel


def pixels_of(png: bytes) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(png)).convert("RGBA"))


def test_a_map_has_the_palettes_colours_and_is_transparent_where_there_is_no_value():
    values = np.array([[0.0, 0.5, 1.0], [np.nan, -3.0, 7.0]])
    shown = pixels_of(colours.png_of(values, "viridis", 0.0, 1.0))
    expected = 255 * np.array(colormaps["viridis"](np.clip(values, 0, 1)))[..., :3]
    seen = np.isfinite(values)
    np.testing.assert_allclose(shown[seen, :3], expected[seen], atol=3)
    assert (shown[..., 3] == np.where(seen, 255, 0)).all()


def test_values_that_do_not_count_are_paler_than_those_that_do():
    values = np.full((1, 2), 4.0)
    full, faded = pixels_of(colours.png_of(values, "RdBu_r", -5.0, 5.0, np.array([[True, False]])))[0, :, :3].astype(
        int
    )
    assert np.ptp(faded) < 0.5 * np.ptp(full)
    assert faded.min() > full.min()


def test_margins_are_cut_and_ticks_and_picture_keep_the_cameras_pixels():
    values = np.full((100, 200), np.nan)
    values[30:80, 40:160] = np.arange(50.0)[:, None]
    panels: list = []
    map_panel(panels, "m", "t", values, "z (mm)", "viridis", 0.0, 49.0, True, origin=(1000, 2000))
    svg = panels[0].svg
    png = base64.b64decode(re.search(r'href="data:image/png;base64,([^"]*)"', svg)[1])
    assert pixels_of(png).shape == (50, 120, 4)
    x, y, width, height = (
        float(re.search(rf'<image [^>]*?\b{name}="([\d.]+)"', svg)[1]) for name in ("x", "y", "width", "height")
    )
    labels = dict(re.findall(r'translate\(([\d.]+) [\d.]+\)" font-size="8.0" text-anchor="middle"[^>]*>(\d+)<', svg))
    assert labels
    for at, col in labels.items():
        assert float(at) == np.float64(round(x + width * (int(col) - 2040 + 0.5) / 120, 2))
    rows = re.findall(r'translate\([\d.]+ ([\d.]+)\)" font-size="8.0" text-anchor="end"[^>]*>(\d+)<', svg)
    assert rows
    for at, row in rows:
        assert abs(float(at) - 3 - (y + height * (int(row) - 1030 + 0.5) / 50)) < 0.011


def test_the_picture_for_papers_shows_the_same_map():
    panels: list = []
    values = np.tile(np.linspace(0, 1, 40), (30, 1))
    map_panel(panels, "m", "t", values, "z (mm)", "viridis", 0.0, 1.0, True)
    shown = np.asarray(Image.open(io.BytesIO(panels[0].png)).convert("RGB")).astype(int)
    row = shown[len(shown) // 2]
    ends = [np.abs(row - 255 * np.array(colormaps["viridis"](end)[:3])).sum(axis=1).argmin() for end in (0.0, 1.0)]
    assert ends[0] < ends[1]
    middle = row[sum(ends) // 2 - 20 : sum(ends) // 2 + 20]
    assert np.abs(middle - 255 * np.array(colormaps["viridis"](0.5)[:3])).sum(axis=1).min() < 25


def test_a_map_of_nothing_is_drawn():
    panels: list = []
    low, high = colours.ends(np.full((5, 6), np.nan))
    map_panel(panels, "m", "t", np.full((5, 6), np.nan), "µm", "RdBu_r", low, high, True)
    assert panels[0].png is not None
