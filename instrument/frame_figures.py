"""Patterns that show what a rig does wrong, and figures of the frames of them: functions of arrays alone."""

import math
from collections.abc import Sequence

import numpy as np

from .contract import Frames

BRIGHTEST_PERCENTILE = 99.5
"""The bright part of a frame, as when a measurement sets its exposure: what is brighter still may saturate."""

LIT = 0.25
"""Pixels count as lit from this share of the bright part on."""

CYCLES = tuple(8 + (k // 2) + 8 * (k % 2) for k in range(16))
"""Stripes across the projector of each pattern of the long sequence, which is longer than the 12 patterns that a
LightCrafter holds. Neighbours in time differ by a third and more, so that a frame which is late by one is not nearly
right; the finest stripes are still more than twice as wide as the finest fringes."""

_LEAST_STRIPES = 0.03  # amplitude over mean; ideal stripes have 1
_LEAST_OF_OTHERS = 0.25  # amplitude over the median of all frames: less is what the mean of all leaves in a frame
_OVER_NOISE = 5.0  # height of a peak over the spectrum's root mean square: of noise alone it stays below 4
_LARGEST_SIDE = 256  # px, of the pictures in which stripes are counted
_PADDING = 2  # finer frequencies


def fringe_patterns(shape: tuple[int, int], period_px: float, steps: int) -> np.ndarray:
    """Fringes along the columns in ``steps`` equal steps over one period, as they are measured with.

    Parameters
    ----------
    shape : (rows, cols)
        Of the projector.
    period_px : float
        In columns.
    steps : int

    Returns
    -------
    (steps, rows, cols) uint8
        I_n = 127.5 (1 + cos(2π x / p + 2π n / N)), rounded. Read-only: all rows share one memory.
    """
    x = np.arange(shape[1])
    return _along_columns(shape, [2 * np.pi * (x / period_px + n / steps) for n in range(steps)])


def stripe_patterns(shape: tuple[int, int]) -> np.ndarray:
    """The long sequence, (16, rows, cols) uint8 for a projector of ``shape``: as many stripes as ``CYCLES`` says.

    Each begins with a phase of its own, so that the mean of all is even. Read-only: all rows share one memory.
    """
    x = np.arange(shape[1]) / shape[1]
    golden = (math.sqrt(5) - 1) / 2
    return _along_columns(shape, [2 * np.pi * (cycles * x + k * golden) for k, cycles in enumerate(CYCLES)])


def _along_columns(shape: tuple[int, int], phases: Sequence[np.ndarray]) -> np.ndarray:
    grey = np.rint(np.round(127.5 * (1 + np.cos(np.stack(phases))), 9)).astype(np.uint8)
    return np.broadcast_to(grey[:, None, :], (len(grey), *shape))


def bright_part(frame: np.ndarray) -> float:
    """Grey value of the bright part of a frame (rows, cols)."""
    return float(np.percentile(frame, BRIGHTEST_PERCENTILE))


def saturated(frames: Frames) -> np.ndarray:
    """Which pixels clip in any of the frames, (rows, cols) bool."""
    return frames.stack.max(axis=0) >= frames.full_scale_dn


def modulation_maps(stack: np.ndarray, black_level_dn: float) -> tuple[np.ndarray, np.ndarray]:
    """Modulation and mean of fringes in four equal steps over one period.

    Parameters
    ----------
    stack : (4, rows, cols)
    black_level_dn : float

    Returns
    -------
    modulation, mean : (rows, cols) float32
        DN: the fringes' amplitude, and what they swing about, above black.
    """
    first, second, third, fourth = stack.astype(np.float32)
    modulation = np.hypot(first - third, second - fourth) / 2
    return modulation, (first + second + third + fourth) / 4 - np.float32(black_level_dn)


def median_contrast(modulation: np.ndarray, mean: np.ndarray, counts: np.ndarray) -> float | None:
    """Median of modulation over mean where it ``counts``, all (rows, cols); None if that is nowhere."""
    counts = counts & (mean > 0)
    return float(np.median(modulation[counts] / mean[counts])) if counts.any() else None


def lit_pixels(light: np.ndarray) -> np.ndarray:
    """Where there is light, (rows, cols) bool, by what a picture has above a dark one, (rows, cols)."""
    return (light > LIT * bright_part(light)) & (light > 0)


def stripe_frequencies(stack: np.ndarray, black_level_dn: float) -> np.ndarray:
    """How often stripes repeat in each frame of a sequence, in whatever direction they run.

    Frames are divided by the mean of all, which takes out what is dark, and multiplied by a Hann window; the frequency
    is that of the highest peak of the spectrum.

    Parameters
    ----------
    stack : (frames, rows, cols)
        Frames of stripes that are unlike each other, so that their mean has none.
    black_level_dn : float

    Returns
    -------
    (frames,) float64
        Cycles per pixel; NaN where there are no stripes.
    """
    block = min(-(-max(stack.shape[1:]) // _LARGEST_SIDE), *stack.shape[1:])
    small = _reduced(stack, block) - np.float32(black_level_dn)
    mean = small.mean(axis=0)
    shape = mean.shape
    window = np.outer(*(np.hanning(size + 2)[1:-1] for size in shape)) * lit_pixels(mean)
    if not window.any():
        return np.full(len(stack), np.nan)
    window = (window / window.sum()).astype(np.float32)
    padded = tuple(_PADDING * size for size in shape)
    frequencies, amplitudes = np.empty(len(stack)), np.empty(len(stack))
    for k, frame in enumerate(small):
        relative = (frame - mean) / np.where(window > 0, mean, 1)
        relative -= (relative * window).sum()  # what is even has no frequency
        spectrum = np.abs(np.fft.fft2(relative * window, padded))
        row, col = (int(index) for index in np.unravel_index(spectrum.argmax(), padded))
        is_noise = spectrum[row, col] < _OVER_NOISE * np.sqrt((spectrum**2).mean())
        amplitudes[k] = 0.0 if is_noise else 2 * spectrum[row, col]
        along = np.array([spectrum[(row + near) % padded[0], col] for near in (-1, 0, 1)])
        across = np.array([spectrum[row, (col + near) % padded[1]] for near in (-1, 0, 1)])
        cycles = [
            (index + _summit(values) + size / 2) % size - size / 2
            for index, values, size in zip((row, col), (along, across), padded, strict=True)
        ]
        frequencies[k] = math.hypot(*(count / size for count, size in zip(cycles, padded, strict=True))) / block
    least = max(_LEAST_STRIPES, _LEAST_OF_OTHERS * float(np.median(amplitudes)))
    return np.where(amplitudes >= least, frequencies, np.nan)


def _reduced(stack: np.ndarray, block: int) -> np.ndarray:
    """Means of square blocks of pixels, (frames, rows // block, cols // block) float32."""
    frames, rows, cols = len(stack), stack.shape[1] // block, stack.shape[2] // block
    blocks = stack[:, : rows * block, : cols * block].reshape(frames, rows, block, cols, block)
    return blocks.mean(axis=(2, 4), dtype=np.float32)


def _summit(values: np.ndarray) -> float:
    """Where a parabola through three values, of which the middle one is the highest, has its summit: -0.5 to 0.5."""
    bend = values[0] - 2 * values[1] + values[2]
    return float((values[0] - values[2]) / (2 * bend)) if bend < 0 else 0.0


def shown_patterns(stack: np.ndarray, black_level_dn: float, cycles: Sequence[int] = CYCLES) -> np.ndarray:
    """Which pattern each frame shows, by its stripes.

    How large the projector's columns are in the picture, and which way they run, need not be known: the scale is that
    which most frames agree on.

    Parameters
    ----------
    stack : (frames, rows, cols)
    black_level_dn : float
    cycles : (patterns,) int
        Stripes of each pattern; frame k should show pattern k.

    Returns
    -------
    (frames,) int64
        Numbers of patterns; -1 where a frame shows none of them.
    """
    counts = np.asarray(cycles, dtype=float)
    frequencies = stripe_frequencies(stack, black_level_dn)
    striped = ~np.isnan(frequencies)
    if not striped.any():
        return np.full(len(stack), -1)
    scale = np.median(frequencies[striped] / counts[striped])
    off = np.abs(np.where(striped, frequencies, 0)[:, None] / scale - counts)
    return np.where(striped & (off.min(axis=1) < 0.5), off.argmin(axis=1), -1)


def dropped_frames(serials: Sequence[np.ndarray], times_s: Sequence[np.ndarray]) -> int:
    """Frames that are missing in a counter that should go on by one, and frames that are no later than the one before.

    Parameters
    ----------
    serials : sequence of (frames,) int64
        Of one capture after the other.
    times_s : sequence of (frames,) float64
    """
    steps = np.diff(np.concatenate(serials))
    late = np.diff(np.concatenate(times_s)) > 0
    return int(np.maximum(steps - 1, 0).sum() + ((steps < 1) | ~late).sum())
