"""The micromirror device: what its patterns look like after the projector's diffraction.

A diamond mirror array stands on a staggered lattice: mirror (row, col) is centred at column ``col`` in even rows and
``col + 1/2`` in odd rows. Coordinates here are (column, row) in units of the column and row pitch, with mirror (0, 0)
at the origin. At the NA of a stereomicroscope the lens removes nearly all of the lattice's own frequency, so a pattern
is convolved with the mirrors' shape and the lens's point spread once, and rendering looks up a smooth function.
"""

from dataclasses import dataclass

import numpy as np

from .diffraction import optical_transfer

MARGIN = 16  # columns and rows beyond the array that still get diffracted light
COLUMN_CELLS = 4  # cells per column of a pattern without rows, see below
IMAGE_CELLS = (4, 2)  # cells per column and per row of a pattern with rows

# Interpolating linearly between cells takes the chord for the arc of a fringe's phasor. Over an angle a per cell the
# phase is wrong by at most a^3 / 62 (the cubic term): 4e-5 rad for a fringe of 12 columns. A small table stays
# in the processor's cache, which is what the time of a stack hangs on.


@dataclass(frozen=True)
class Mirrors:
    """Geometry of the array as it appears at the specimen, mm, and how it answers to grey values."""

    column_pitch: float
    row_pitch: float
    fill: float
    off_state: float  # light of a mirror that is off, relative to one that is on
    gamma: float = 1.0  # exponent of the light over the grey values


@dataclass(frozen=True)
class PatternTable:
    """Patterns as a function of (column, row), ready to be looked up.

    Parameters
    ----------
    values : (table_rows, table_cols, N) float32
        Light relative to a white pattern without end. One row means that the patterns do not vary along the rows.
    row_profile : (profile_cells,) float32
        Light across the rows where ``values`` has one row: 1 inside, falling at the first and last mirror.
    origin : (column, row)
        Coordinates of the first cell's centre.
    cells : (per_column, per_row)
        Table cells per column and per row.
    interpolate : bool
        False shows each cell as a square.
    """

    values: np.ndarray
    row_profile: np.ndarray
    origin: tuple[float, float]
    cells: tuple[int, int]
    interpolate: bool


def square_pixels(patterns: np.ndarray) -> PatternTable:
    """An ideal projector's table: ``patterns``, (N, rows, cols) uint8, as square pixels without diffraction."""
    values = np.ascontiguousarray(np.moveaxis(patterns, 0, -1), np.float32) / np.float32(255)
    return PatternTable(values, np.ones(1, np.float32), (0.0, 0.0), (1, 1), False)


def band_limited(
    patterns: np.ndarray, mirrors: Mirrors, na: float, wavelength: float, shift: np.ndarray | None = None
) -> PatternTable:
    """Table of ``patterns``, (N, rows, cols) uint8, through mirrors of diamond shape and a lens of aperture ``na``.

    At a place the table shows what lies ``shift``, (N, 2) columns and rows, further on in each pattern. Patterns that
    do not vary along the rows share one profile across them, which is not shifted.
    """
    shift = np.zeros((len(patterns), 2)) if shift is None else shift
    if (patterns == patterns[:, :1]).all():
        light = _light(patterns[:, 0], mirrors)
        return _column_table(light, patterns.shape[1], mirrors, na, wavelength, shift[:, 0])
    return _image_table(_light(patterns, mirrors), mirrors, na, wavelength, shift)


def _light(patterns: np.ndarray, mirrors: Mirrors) -> np.ndarray:
    """Light of mirrors that show grey values, relative to white, float32 of any shape."""
    answer = (255 * (np.arange(256) / 255) ** mirrors.gamma).astype(np.float32)  # in grey values
    return mirrors.off_state + (1 - mirrors.off_state) * answer[patterns] / 255


def _transfer(fx: np.ndarray, fy: np.ndarray, mirrors: Mirrors, na: float, wavelength: float) -> np.ndarray:
    """Transfer function of mirror shape and lens at frequencies in 1/mm; 1 at zero."""
    # A diamond with the diagonals a and b is the image of a square turned by 45 degrees.
    a, b = np.sqrt(mirrors.fill) * mirrors.column_pitch, np.sqrt(mirrors.fill) * 2 * mirrors.row_pitch
    shape = np.sinc((fx * a + fy * b) / 2) * np.sinc((fx * a - fy * b) / 2)
    return shape * optical_transfer(np.hypot(fx, fy), na, wavelength)


def _column_table(
    light: np.ndarray, rows: int, mirrors: Mirrors, na: float, wavelength: float, shift: np.ndarray
) -> PatternTable:
    n, cols = light.shape
    # Half of the mirrors of a column stand in even rows, half in odd rows, half a column further on.
    lattice = np.zeros((n, (cols + 2 * MARGIN) * COLUMN_CELLS), np.float32)
    first = MARGIN * COLUMN_CELLS
    for stagger in (0, COLUMN_CELLS // 2):
        place = first + stagger
        lattice[:, place : place + cols * COLUMN_CELLS : COLUMN_CELLS] += light * (COLUMN_CELLS / 2)
    optics = (mirrors, na, wavelength)
    step = mirrors.column_pitch / COLUMN_CELLS
    values = _filtered(lattice, step, "column", optics, mirrors.column_pitch * shift)
    comb = np.zeros((1, (rows + 2 * MARGIN) * COLUMN_CELLS), np.float32)
    comb[0, first : first + rows * COLUMN_CELLS : COLUMN_CELLS] = COLUMN_CELLS
    profile = _filtered(comb, mirrors.row_pitch / COLUMN_CELLS, "row", optics, np.zeros(1))
    table = np.ascontiguousarray(values.T)[None]
    return PatternTable(table, profile[0], (-float(MARGIN), -float(MARGIN)), (COLUMN_CELLS, COLUMN_CELLS), True)


def _filtered(
    samples: np.ndarray, step: float, axis: str, optics: tuple[Mirrors, float, float], shift: np.ndarray
) -> np.ndarray:
    """Rows of ``samples``, (N, cells) at ``step`` mm, through the transfer along one axis and back by ``shift`` mm."""
    frequency = np.fft.rfftfreq(samples.shape[1], step)
    zero = np.zeros_like(frequency)
    transfer = _transfer(frequency, zero, *optics) if axis == "column" else _transfer(zero, frequency, *optics)
    spectrum = np.fft.rfft(samples, axis=1) * transfer * np.exp(2j * np.pi * np.outer(shift, frequency))
    return np.fft.irfft(spectrum, samples.shape[1], axis=1).astype(np.float32)


def _image_table(light: np.ndarray, mirrors: Mirrors, na: float, wavelength: float, shift: np.ndarray) -> PatternTable:
    n, rows, cols = light.shape
    across, down = IMAGE_CELLS
    shape = ((rows + 2 * MARGIN) * down, (cols + 2 * MARGIN) * across)
    fx = np.fft.rfftfreq(shape[1], mirrors.column_pitch / across)[None, :]
    fy = np.fft.fftfreq(shape[0], mirrors.row_pitch / down)[:, None]
    transfer = _transfer(fx, fy, mirrors, na, wavelength)
    values = np.empty((*shape, n), np.float32)
    top, left = MARGIN * down, MARGIN * across
    for k in range(n):
        lattice = np.zeros(shape, np.float32)
        for parity in (0, 1):
            row = top + parity * down
            column = left + parity * across // 2
            lattice[row : top + rows * down : 2 * down, column : column + cols * across : across] = light[
                k, parity::2
            ] * (across * down)
        ahead = np.exp(2j * np.pi * (fx * mirrors.column_pitch * shift[k, 0] + fy * mirrors.row_pitch * shift[k, 1]))
        values[..., k] = np.fft.irfft2(np.fft.rfft2(lattice) * transfer * ahead, shape)
    return PatternTable(values, np.ones(1, np.float32), (-float(MARGIN), -float(MARGIN)), IMAGE_CELLS, True)
