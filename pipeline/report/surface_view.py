"""Surfaces as the page carries them for its 3D view: a grid of heights, and what colours them, in two bytes a value."""

import base64
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from greenough.instrument.errors import InputError

from ..point_cloud import PointCloud
from . import colours

MOST_POINTS = 1_400_000
"""Larger grids are thinned to every second, third ... pixel: a browser still turns so many points fluidly."""

HEIGHT_STEP_MM = 1e-4
"""Heights are rounded to 0.1 µm, far below the noise, or coarser where the range would need more than 16 bits."""

BRIGHTNESS = "brightness"
"""The layer of a cloud's light."""

_CODES = 65534
_LEVELS = 128  # between the ends of the colours of a layer that is no height
_SAMPLE = 5_000  # points that x and y are fitted to
_WIDEST_MM = 1e5
_SPARSEST = 8  # pixels of a grid for each of its points
_EXAGGERATED = 0.2  # share of the width that heights fill at first


@dataclass(frozen=True, eq=False)
class Layer:
    """Values that colour a surface, and between which ends.

    Parameters
    ----------
    name, unit : str
    values : (rows, cols) float
        NaN where there is none.
    low, high : float
        Ends of the colours.
    palette : str
        One of `colours`.
    digits : int
        Decimals shown.
    """

    name: str
    unit: str
    values: np.ndarray
    low: float
    high: float
    palette: str
    digits: int = 2


@dataclass(frozen=True, eq=False)
class SurfaceView:
    """One surface to look at.

    Parameters
    ----------
    name : str
    xyz : (rows, cols, 3) float
        Points by pixel, mm; NaN where there is none.
    layers : sequence of Layer
        Beside the height, of the same rows and columns.
    note : str
        What was filtered and aligned.
    origin : (int, int)
        Row and column of the first pixel in the camera's picture.
    """

    name: str
    xyz: np.ndarray
    layers: Sequence[Layer] = ()
    note: str = ""
    origin: tuple[int, int] = (0, 0)


def error_layer(values_um: np.ndarray, name: str = "error", percentile: float = 99.0) -> Layer:
    """Errors in µm, with colours about 0."""
    limit = colours.reach(values_um, percentile)
    return Layer(name, "µm", values_um, -limit, limit, colours.ERROR, 1)


def uncertainty_layer(name: str, values_um: np.ndarray) -> Layer:
    """Standard uncertainties in µm, with colours from 0."""
    return Layer(name, "µm", values_um, 0.0, colours.reach(values_um), colours.UNCERTAINTY, 2)


def view_of_cloud(
    name: str, cloud: PointCloud, layers: Mapping[str, np.ndarray] | None = None, note: str = ""
) -> SurfaceView:
    """A cloud on the grid of its pixels, or binned to a regular grid of x and y where it does not know them.

    ``layers`` are errors (n,) in µm of the cloud's points; their uncertainties and brightness come by themselves.
    InputError if points lie so far apart that nothing would be seen.
    """
    errors = {key: np.asarray(each, dtype=np.float32) for key, each in (layers or {}).items()}
    sigmas = {"σ z by noise": cloud.noise_mm, "σ z by calibration": cloud.calibration_mm}
    sigmas = {key: (1e3 * sd[:, 2]).astype(np.float32) for key, sd in sigmas.items() if sd is not None}
    places, origin, shape, step = _places(cloud)

    def gridded(each: np.ndarray) -> np.ndarray:
        grid = np.full((*shape, *each.shape[1:]), np.nan, dtype=each.dtype)
        grid[places[:, 0], places[:, 1]] = each
        return grid

    made = [error_layer(gridded(each), key) for key, each in errors.items()]
    made += [uncertainty_layer(key, gridded(each)) for key, each in sigmas.items()]
    if cloud.intensity is not None:
        values = gridded(cloud.intensity.astype(np.float32))
        made.append(Layer(BRIGHTNESS, "DN", values, 0.0, max(colours.ends(values, 99.5)[1], 1.0), colours.LIGHT, 0))
    if step:
        note = f"{note} The points know no pixels: shown is one of each cell of {1e3 * step:.3g} µm.".strip()
    return SurfaceView(name, gridded(cloud.xyz), made, note, origin)


def _places(cloud: PointCloud) -> tuple[np.ndarray, tuple[int, int], tuple[int, int], float]:
    """Row and column (n, 2) of each point in a grid, the grid's origin and shape, and a new grid's step in mm or 0."""
    spread = float(np.ptp(cloud.xyz, axis=0).max())
    if not spread <= _WIDEST_MM:
        raise InputError(
            f"the points lie {spread:.3g} mm apart, and at most {_WIDEST_MM:g} are shown: leave stray ones out"
        )
    if cloud.pixels is not None:
        pixels = cloud.pixels.astype(np.int64)
        first = pixels.min(axis=0)
        rows, cols = (int(n) for n in pixels.max(axis=0) - first + 1)
        if rows * cols <= _SPARSEST * max(len(cloud.xyz), 1 << 16):  # what a file claims must not fill the memory
            return pixels - first, (int(first[0]), int(first[1])), (rows, cols), 0.0
    low, high = cloud.xyz[:, :2].min(axis=0), cloud.xyz[:, :2].max(axis=0)
    area = float(np.prod(np.maximum(high - low, 1e-9)))
    step = max(np.sqrt(area / min(len(cloud.xyz), MOST_POINTS)), float((high - low).max()) / 4000, 1e-9)
    cols, rows = (int(n) for n in np.floor((high - low) / step).astype(int) + 1)
    col = np.floor((cloud.xyz[:, 0] - low[0]) / step).astype(int)
    row = np.floor((high[1] - cloud.xyz[:, 1]) / step).astype(int)
    return np.stack([np.minimum(row, rows - 1), np.minimum(col, cols - 1)], axis=-1), (0, 0), (rows, cols), step


def payload(view: SurfaceView) -> dict[str, Any]:
    """What the page's script needs of a surface, for JSON."""
    window = _window(np.isfinite(view.xyz[..., 2]))
    step = 1
    while _count(window, step) > MOST_POINTS:
        step += 1
    thin = tuple(slice(each.start, each.stop, step) for each in window)
    xyz = view.xyz[thin]
    z = xyz[..., 2]
    rows, cols = z.shape
    low, high = _extremes(z)
    middle, half = (low + high) / 2, max((high - low) / 2, 1e-6)
    x_terms, y_terms = _fit(xyz, middle, half)
    dx_du, dx_dv, dy_du, dy_dv = (
        2 * terms[k] / max(n - 1, 1) for terms in (x_terms, y_terms) for k, n in ((1, cols), (2, rows))
    )
    determinant = dx_du * dy_dv - dx_dv * dy_du
    across = np.array([dy_dv, -dy_du, -dx_dv, dx_du]) / (determinant or 1.0)
    width = max(np.hypot(x_terms[1], y_terms[1]), np.hypot(x_terms[2], y_terms[2]), 1e-9)
    bottom, top = colours.ends(z, 99.5)
    exaggeration = np.clip(_EXAGGERATED * 2 * width / (top - bottom), 1, 100)
    lowest, highest = colours.ends(z)
    return {
        "note": view.note + (f" Shown is one pixel of {step} x {step}." if step > 1 else ""),
        "rows": rows,
        "cols": cols,
        "row0": view.origin[0] + window[0].start,
        "col0": view.origin[1] + window[1].start,
        "pixel_step": step,
        "x": [float(term) for term in x_terms],
        "y": [float(term) for term in y_terms],
        "z_middle": middle,
        "z_half": half,
        "across": [float(each) for each in across],
        "centre": [float(x_terms[0]), float(y_terms[0]), float(np.mean(colours.ends(z)))],
        "radius": float(np.hypot(width, width) * 0.85),
        "exaggeration": float(exaggeration),
        "layers": [
            _encoded(Layer("height", "mm", z, lowest, highest, colours.HEIGHT, 3), HEIGHT_STEP_MM),
            *(
                _encoded(
                    Layer(each.name, each.unit, each.values[thin], each.low, each.high, each.palette, each.digits),
                    (each.high - each.low) / _LEVELS,
                )
                for each in view.layers
            ),
        ],
    }


def palettes(views: Sequence[SurfaceView]) -> dict[str, str]:
    """The palettes of all layers, 256 colours of three bytes in base64."""
    names = {colours.HEIGHT} | {layer.palette for view in views for layer in view.layers}
    return {name: base64.b64encode(colours.palette(name).tobytes()).decode("ascii") for name in sorted(names)}


def _encoded(layer: Layer, step: float) -> dict[str, Any]:
    """A layer as codes: 0 is no value, code q is zero + step (q - 1); see ``codesOf`` in the script."""
    low, high = _extremes(layer.values)
    if layer.name != "height":  # a few wild values must not make the others coarse
        span = layer.high - layer.low
        low, high = max(low, layer.low - 20 * span), min(high, layer.high + 20 * span)
    step = max(step, (high - low) / (_CODES - 1))
    seen = np.isfinite(layer.values)
    scaled = np.rint((np.clip(np.where(seen, layer.values, low), low, high) - low) / step)
    codes = np.where(seen, scaled + 1, 0).astype(np.uint16).ravel()
    difference = np.diff(codes, prepend=np.uint16(0)).astype(np.int16)
    zigzag = (difference.astype(np.int32) << 1 ^ (difference >> 15)).astype(np.uint16)
    planes = np.concatenate([zigzag & 0xFF, zigzag >> 8]).astype(np.uint8)
    return {
        "name": layer.name,
        "unit": layer.unit,
        "zero": low,
        "step": step,
        "low": layer.low,
        "high": layer.high,
        "palette": layer.palette,
        "digits": layer.digits,
        "data": base64.b64encode(zlib.compress(planes.tobytes(), 3)).decode("ascii"),
    }


def _fit(xyz: np.ndarray, middle: float, half: float) -> tuple[np.ndarray, np.ndarray]:
    """Coefficients (13,) of x and of y, mm, over pixel and height, as the script evaluates them.

    Rays of a lens are straight, so that height enters linearly; distortion needs cubes. What is left is below 0.1 µm
    for a camera, and nothing for a regular grid.
    """
    rows, cols = xyz.shape[:2]
    v, u = np.nonzero(np.isfinite(xyz[..., 2]))
    if len(u) == 0:
        return np.eye(13)[1], -np.eye(13)[2]
    chosen = slice(None, None, max(1, len(u) // _SAMPLE))
    u, v = u[chosen], v[chosen]
    x, y, z = xyz[v, u].T.astype(np.float64)
    n, m = (2 * u - cols + 1) / max(cols - 1, 1), (2 * v - rows + 1) / max(rows - 1, 1)
    h = (z - middle) / half
    design = np.stack(
        [np.ones_like(n), n, m, n * n, n * m, m * m, h, h * n, h * m, n**3, n * n * m, n * m * m, m**3], axis=-1
    )
    solution = np.linalg.lstsq(design, np.column_stack([x, y]), rcond=1e-9)[0]
    return solution[:, 0], solution[:, 1]


def _window(seen: np.ndarray) -> tuple[slice, slice]:
    """Rows and columns that hold everything seen; all where nothing is."""
    rows, cols = np.flatnonzero(seen.any(axis=1)), np.flatnonzero(seen.any(axis=0))
    if len(rows) == 0:
        return slice(0, seen.shape[0]), slice(0, seen.shape[1])
    return slice(int(rows[0]), int(rows[-1]) + 1), slice(int(cols[0]), int(cols[-1]) + 1)


def _count(window: tuple[slice, slice], step: int) -> int:
    rows, cols = (-(-(each.stop - each.start) // step) for each in window)
    return rows * cols


def _extremes(values: np.ndarray) -> tuple[float, float]:
    seen = values[np.isfinite(values)]
    return (float(seen.min()), float(seen.max())) if len(seen) else (0.0, 1.0)
