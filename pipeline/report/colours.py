"""Values to colours: the palettes, and maps as small PNG pictures of one byte per pixel."""

import io
from functools import cache

import numpy as np
from matplotlib import colormaps
from PIL import Image

HEIGHT, ERROR, UNCERTAINTY, LIGHT = "viridis", "RdBu_r", "cividis", "gray"
"""Palettes: heights, signed errors about 0, uncertainties, and pictures of the camera. The first three are perceptually
uniform or nearly so."""

VOID, FADED = 255, 128
"""Codes of a map: no value; and what is added to the codes 0 to 126 where values are shown but do not count."""

_LEVELS = 255  # of a map in which all values count
_VOID_GREY = 140
_FADED_SHARE, _FADED_GREY = 0.65, 217


@cache
def palette(name: str, levels: int = 256) -> np.ndarray:
    """Colours from the lowest to the highest, (levels, 3) uint8."""
    return np.round(255 * colormaps[name](np.linspace(0, 1, levels))[:, :3]).astype(np.uint8)


def png_of(
    values: np.ndarray,
    name: str,
    low: float,
    high: float,
    counts: np.ndarray | None = None,
    compress_level: int = 4,
    levels: int = 256,
) -> bytes:
    """A map as PNG, one pixel per value.

    Parameters
    ----------
    values : (rows, cols) float
        NaN is transparent.
    name : str
        The palette.
    low, high : float
        Its ends; what lies beyond has their colours.
    counts : (rows, cols) bool, optional
        Where it is False, colours are faded.
    compress_level : int
        Of zlib.
    levels : int
        Colours: less where neighbours differ by noise make the file smaller. At most 127 with ``counts``.
    """
    levels = min(levels, _LEVELS if counts is None else FADED - 1)
    share = np.clip((values - low) / (high - low or 1.0), 0, 1)
    void = ~np.isfinite(share)
    codes = np.rint(np.where(void, 0, share) * (levels - 1)).astype(np.uint8)
    colours = np.full((256, 3), _VOID_GREY, dtype=np.uint8)
    colours[:levels] = palette(name, levels)
    if counts is not None:
        faded = (1 - _FADED_SHARE) * colours[:levels].astype(float) + _FADED_SHARE * _FADED_GREY
        colours[FADED : FADED + levels] = np.round(faded).astype(np.uint8)
        codes = np.where(counts, codes, codes + FADED).astype(np.uint8)
    codes[void] = VOID
    image = Image.fromarray(codes)
    image.putpalette(colours.ravel().tolist())
    png = io.BytesIO()
    image.save(png, format="png", transparency=VOID, compress_level=compress_level)
    return png.getvalue()


def ends(values: np.ndarray, percentile: float = 99.0) -> tuple[float, float]:
    """Percentiles ``100 - percentile`` and ``percentile`` of the finite values; 0 and 1 without any."""
    seen = values[np.isfinite(values)]
    low, high = np.percentile(seen, [100 - percentile, percentile]) if len(seen) else (0.0, 1.0)
    return (float(low), float(high)) if high > low else (float(low) - 0.5, float(low) + 0.5)


def reach(values: np.ndarray, percentile: float = 99.0) -> float:
    """Percentile of the absolute finite values, for colours about 0; 1 without any, or where all are 0."""
    seen = np.abs(values[np.isfinite(values)])
    return float(np.percentile(seen, percentile)) or 1.0 if len(seen) else 1.0
