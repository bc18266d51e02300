"""Claims about patterns behind the mirrors' shape and the lens."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from greenough.twin.diffraction import optical_transfer
from greenough.twin.dmd import MARGIN, Mirrors, PatternTable, band_limited, square_pixels

NA, WAVELENGTH = 0.015, 0.525e-3
PITCH = 17.835e-3
MIRRORS = Mirrors(column_pitch=PITCH, row_pitch=8.923e-3, fill=0.92, off_state=0.0)


def cosine(cols: int, period: float, step: int = 0, steps: int = 4) -> np.ndarray:
    """Eq. 1 in whole grey values, (cols,); exact halves round alike in every period."""
    exact = 127.5 * (1 + np.cos(2 * np.pi * (np.arange(cols) / period + step / steps)))
    return np.rint(np.round(exact, 9)).astype(np.uint8)


def columns(lines: np.ndarray, rows: int = 40) -> np.ndarray:
    """Patterns (N, rows, cols) that do not vary along the rows."""
    return np.repeat(np.atleast_2d(lines)[:, None], rows, axis=1)


def centres(table: PatternTable) -> tuple[np.ndarray, np.ndarray]:
    """Columns and rows of a table's cells."""
    x = table.origin[0] + np.arange(table.values.shape[1]) / table.cells[0]
    y = table.origin[1] + np.arange(table.values.shape[0]) / table.cells[1]
    return x, y


@pytest.mark.parametrize("period", [12.0, 40.0, 16.5])
def test_a_fringe_keeps_the_phase_of_its_columns_and_gets_the_analytic_contrast(period):
    whole = int(period * 2)  # columns after which the pattern repeats
    cols = whole * (600 // whole)
    table = band_limited(columns(cosine(cols, period)), MIRRORS, NA, WAVELENGTH)
    x, _ = centres(table)
    # Whole periods well inside the array; its edges are 100 columns away.
    inside = (x >= 100) & (x < 100 + whole * ((cols - 200) // whole))
    fundamental = np.mean(table.values[0, inside, 0] * np.exp(-2j * np.pi * x[inside] / period))

    # The grey values' own fundamental, and every column half in even and half in odd rows, half a column further on.
    grey = cosine(cols, period)[:whole] / 255
    column = np.arange(whole)
    sent = np.mean(grey * np.exp(-2j * np.pi * column / period))
    stagger = (1 + np.exp(-1j * np.pi / period)) / 2
    f = 1 / (period * PITCH)
    diagonal = np.sqrt(0.92) * PITCH
    transfer = np.sinc(f * diagonal / 2) ** 2 * optical_transfer(np.array(f), NA, WAVELENGTH)
    # What is missing beyond the edges, 100 columns away, is a thousandth of the light, and nearly even over a period.
    assert abs(fundamental - sent * stagger * transfer) < 1e-5

    # And by themselves: the phase is that of the columns with a quarter of a column's stagger, within the rounding of
    # grey values, which is uniform over one of them.
    rounding = 1 / 255 / np.sqrt(12) / np.sqrt(whole)
    assert abs(np.angle(fundamental) + 2 * np.pi * 0.25 / period) < 4 * rounding / 0.25


def test_a_white_pattern_is_one_inside_and_its_edge_is_half():
    table = band_limited(np.full((1, 60, 80), 255, np.uint8), MIRRORS, NA, WAVELENGTH)
    x, _ = centres(table)
    assert table.values.shape[0] == 1
    assert_allclose(table.values[0, np.abs(x - 39.75) < 20, 0], 1, atol=0.01)
    # Columns cover [-1/2, cols - 1/2] in even rows and half a column more in odd ones: together half as bright there.
    assert np.interp(-0.25, x, table.values[0, :, 0]) == pytest.approx(0.5, abs=0.01)
    assert np.interp(79.75, x, table.values[0, :, 0]) == pytest.approx(0.5, abs=0.01)
    y = table.origin[1] + np.arange(len(table.row_profile)) / table.cells[1]
    assert np.interp(-0.5, y, table.row_profile) == pytest.approx(0.5, abs=0.01)
    assert np.interp(59.5, y, table.row_profile) == pytest.approx(0.5, abs=0.01)


def test_a_pattern_with_rows_is_the_one_without_where_its_rows_are_alike():
    lines = np.stack([cosine(96, 12.0, step) for step in range(3)])
    plain = columns(lines, rows=90)
    uneven = plain.copy()
    uneven[:, -1, ::2] ^= 1  # one grey value in the last row makes it a pattern with rows
    column_table = band_limited(plain, MIRRORS, NA, WAVELENGTH)
    image_table = band_limited(uneven, MIRRORS, NA, WAVELENGTH)
    assert column_table.values.shape[0] == 1
    assert image_table.values.shape[0] > 1

    x, y = centres(image_table)
    periods = (x >= 24) & (x < 72)
    rows = (y > 25) & (y < 65)
    carrier = np.exp(-2j * np.pi * x[periods] / 12)
    lines = image_table.values[:, periods][rows]  # (rows, cells, patterns)
    across, _ = centres(column_table)
    line = np.stack([np.interp(x[periods], across, column_table.values[0, :, k]) for k in range(3)], axis=-1)
    # The fringe: at this aperture the lens lets no sideband of the staggered rows through.
    assert_allclose((lines * carrier[:, None]).mean(axis=1) - (line * carrier[:, None]).mean(axis=0), 0, atol=1e-4)
    # The mean light: what spreads past the first and last row is in the profile. Two edges are not quite a rectangle's
    # corner: each takes at most a hundredth of the light here, both together the square of that.
    profile = np.interp(
        y[rows],
        column_table.origin[1] + np.arange(len(column_table.row_profile)) / column_table.cells[1],
        column_table.row_profile,
    )
    assert_allclose(lines.mean(axis=1), profile[:, None] * line.mean(axis=0), atol=3e-4)


@settings(max_examples=30)
@given(st.integers(0, 2**32 - 1), st.booleans())
def test_no_light_is_lost(seed, along_rows):
    rng = np.random.default_rng(seed)
    patterns = rng.integers(0, 256, (2, 20, 24), dtype=np.uint8)
    if not along_rows:
        patterns = columns(patterns[:, 0], 20)
    table = band_limited(patterns, MIRRORS, NA, WAVELENGTH)
    cell = 1 / (table.cells[0] * table.cells[1])
    total = table.values.astype(float).sum(axis=(0, 1)) * cell
    if not along_rows:
        total *= table.row_profile.astype(float).sum()
    assert_allclose(total, patterns.sum(axis=(1, 2)) / 255, rtol=1e-5)


@pytest.mark.parametrize(("row", "col"), [(10, 12), (11, 12)])
def test_a_single_mirror_shines_symmetrically_around_its_place_on_the_staggered_lattice(row, col):
    patterns = np.zeros((1, 20, 24), np.uint8)
    patterns[0, row, col] = 255
    table = band_limited(patterns, MIRRORS, NA, WAVELENGTH)
    values = table.values[..., 0]
    j = round((col + (row % 2) / 2 - table.origin[0]) * table.cells[0])
    i = round((row - table.origin[1]) * table.cells[1])
    window = values[i - 20 : i + 21, j - 30 : j + 31]
    assert window.argmax() == window.size // 2
    assert_allclose(window, window[:, ::-1], atol=1e-6)
    assert_allclose(window, window[::-1], atol=1e-6)


def test_a_single_mirror_is_seen_as_the_airy_pattern_of_the_lens():
    # A mirror is smaller than the Airy disc; what it adds to the pattern is in the transfer function's product.
    patterns = np.zeros((1, 20, 24), np.uint8)
    patterns[0, 10, 12] = 255
    table = band_limited(patterns, MIRRORS, NA, WAVELENGTH)
    peak = table.values.max()
    # At the peak: the integral over all frequencies of mirror and lens, by brute force on another grid.
    f = np.linspace(-60, 60, 1201)
    fx, fy = np.meshgrid(f, f)
    a, b = np.sqrt(0.92) * PITCH, np.sqrt(0.92) * 2 * 8.923e-3
    mirror = np.sinc((fx * a + fy * b) / 2) * np.sinc((fx * a - fy * b) / 2)
    total = (mirror * optical_transfer(np.hypot(fx, fy), NA, WAVELENGTH)).sum() * (f[1] - f[0]) ** 2
    assert peak == pytest.approx(total * PITCH * 8.923e-3, rel=2e-3)


def test_the_mirrors_transfer_function_is_that_of_a_diamond():
    """The transform of a diamond by quadrature over its area, against what the table leaves of a fringe."""
    fill = 0.92
    a, b = np.sqrt(fill) * PITCH, np.sqrt(fill) * 2 * 8.923e-3
    n = 2000
    x = ((np.arange(n) + 0.5) / n - 0.5) * a
    height = b * (1 - 2 * np.abs(x) / a)  # of the diamond at x
    f = 1 / (12 * PITCH)
    expected = (height * np.cos(2 * np.pi * f * x)).sum() / height.sum()
    table = band_limited(columns(cosine(240, 12.0)), MIRRORS, NA, WAVELENGTH)
    at, _ = centres(table)
    inside = (at >= 60) & (at < 180)
    fundamental = np.abs(np.mean(table.values[0, inside, 0] * np.exp(-2j * np.pi * at[inside] / 12)))
    sent = np.abs(np.mean(cosine(12, 12.0) / 255 * np.exp(-2j * np.pi * np.arange(12) / 12)))
    lens = optical_transfer(np.array(f), NA, WAVELENGTH) * np.cos(np.pi / 24)
    assert fundamental / sent / lens == pytest.approx(expected, abs=1e-4)


def test_dark_mirrors_still_send_the_light_of_their_off_state():
    mirrors = Mirrors(PITCH, 8.923e-3, 0.92, off_state=0.1)
    patterns = columns(np.stack([np.zeros(80, np.uint8), np.full(80, 255, np.uint8)]), 60)
    table = band_limited(patterns, mirrors, NA, WAVELENGTH)
    x, _ = centres(table)
    middle = table.values[0, np.abs(x - 39.75) < 10]
    assert_allclose(middle[:, 0], 0.1 * middle[:, 1], rtol=1e-5)
    assert_allclose(middle[:, 1], 1, atol=0.01)


def test_the_edge_of_the_array_is_blurred_as_an_edge_seen_through_mirrors_and_lens():
    table = band_limited(np.full((1, 40, 200), 255, np.uint8), MIRRORS, NA, WAVELENGTH)
    x, _ = centres(table)
    near = (x > -4) & (x < 20)
    # Mirrors of even and odd rows together are a row of points, h apart, that starts at 0: its transform is
    # exp(pi i f h) / (2 i sin(pi f h)), an edge at -h / 2 in place of 1 / (2 pi i f h).
    h = PITCH / 2
    f = (np.arange(20000) + 0.5) / 20000 * 2 * NA / WAVELENGTH
    diagonal = np.sqrt(0.92) * PITCH
    transfer = np.sinc(f * diagonal / 2) ** 2 * optical_transfer(f, NA, WAVELENGTH)
    distance = x[near] * PITCH + h / 2
    waves = np.sin(2 * np.pi * f * distance[:, None]) * transfer / np.sin(np.pi * f * h)
    edge = 0.5 + waves.sum(axis=1) * h * (f[1] - f[0])
    # The table's period brings back the array's other end, 28 columns away: the Airy pattern's tail at x is
    # lambda / (2 NA) / (pi^2 x) of the light.
    tail = WAVELENGTH / (2 * NA) / (np.pi**2 * (2 * MARGIN - 4) * PITCH)
    assert_allclose(table.values[0, near, 0], edge, atol=tail)


def test_square_pixels_are_the_patterns_themselves():
    patterns = np.random.default_rng(0).integers(0, 256, (3, 5, 7), dtype=np.uint8)
    table = square_pixels(patterns)
    assert not table.interpolate
    assert (table.origin, table.cells) == ((0.0, 0.0), (1, 1))
    assert_allclose(table.values, np.moveaxis(patterns, 0, -1) / 255, rtol=1e-6)
