"""A picture of where points depart from the mesh that they should lie on."""

from pathlib import Path

import numpy as np

from greenough.instrument.files import atomic_path

_SCALE_PERCENTILE = 99.0
_MOST_PIXELS = 1 << 25
_MOST_POINTS = 100_000  # that are drawn one by one
_BINS = 120


def write_error_map(
    path: str | Path,
    xyz: np.ndarray,
    errors_um: np.ndarray,
    tolerance_um: float,
    title: str,
    pixels: np.ndarray | None = None,
) -> None:
    """Draw errors as a map with its scale, and their histogram, as PNG; the file appears whole or not at all.

    The scale is symmetric and reaches to the tolerance at least, and to the 99th percentile of the errors' sizes.

    Parameters
    ----------
    path : str or Path
    xyz : (n, 3)
        Points, mm.
    errors_um : (n,)
        NaN where there is no error to be told.
    tolerance_um : float
        Marked in the histogram.
    title : str
    pixels : (n, 2) int, optional
        (row, col) that saw each point: the map is the camera's picture then, and else seen along z.
    """
    from matplotlib.figure import Figure

    known = np.isfinite(errors_um)
    sizes = np.abs(errors_um[known])
    scale = max(tolerance_um, float(np.percentile(sizes, _SCALE_PERCENTILE))) if known.any() else tolerance_um
    figure = Figure(figsize=(11, 4.6), dpi=120, layout="constrained")
    figure.suptitle(title, parse_math=False, fontsize="medium", wrap=True)
    places, counts = figure.subplots(1, 2, width_ratios=(1.7, 1))
    style = {"cmap": "RdBu_r", "vmin": -scale, "vmax": scale}
    places.set_facecolor("0.8")
    corner, shape = _window(pixels)
    if pixels is not None and 0 < shape[0] * shape[1] <= _MOST_PIXELS:
        image = np.full(shape, np.nan)
        image[tuple((pixels - corner).T)] = errors_um
        extent = (corner[1] - 0.5, corner[1] + shape[1] - 0.5, corner[0] + shape[0] - 0.5, corner[0] - 0.5)
        drawn = places.imshow(image, extent=extent, interpolation="nearest", **style)
        where, names = pixels[:, ::-1], ("column, px", "row, px")
    else:
        chosen = np.s_[:: max(1, len(xyz) // _MOST_POINTS)]
        drawn = places.scatter(*xyz[chosen, :2].T, c=errors_um[chosen], s=4, linewidths=0, **style)
        places.set_aspect("equal")
        where, names = xyz[:, :2], ("x, mm", "y, mm")
    places.set_xlabel(names[0])
    places.set_ylabel(names[1])
    figure.colorbar(drawn, ax=places, label="vertical error, µm", extend="both")
    if known.any():
        worst = int(np.nanargmax(np.abs(errors_um)))
        for width, colour in ((3, "white"), (1.2, "black")):  # to be seen on any ground
            circle = {"markersize": 14, "fillstyle": "none", "clip_on": False}
            places.plot(*where[worst], "o", color=colour, markeredgewidth=width, **circle)
        places.set_title(f"circle: the worst, {errors_um[worst]:+.4g} µm", fontsize="small")
        counts.hist(np.clip(errors_um[known], -scale, scale), _BINS, range=(-scale, scale), color="0.4")
        share = np.mean(sizes <= tolerance_um)
        p95 = np.quantile(sizes, 0.95)
        counts.set_title(
            f"bias {errors_um[known].mean():.4g}, rms {np.sqrt(np.mean(sizes**2)):.4g}, 95 % {p95:.4g} µm; "
            f"n = {len(sizes)}\n{share:.1%} within ±{tolerance_um:g} µm",
            fontsize="small",
        )
    else:
        places.set_title("no point lies above or below the mesh", fontsize="small")
    for side in (-tolerance_um, tolerance_um):
        counts.axvline(side, color="tab:red", linestyle="--")
    counts.set_xlabel("vertical error, µm (outermost bars: and beyond)")
    counts.set_ylabel("points")
    with atomic_path(path) as temporary:
        figure.savefig(temporary)


def _window(pixels: np.ndarray | None) -> tuple[np.ndarray, tuple[int, int]]:
    """First row and column of the pixels, and how many there are of each."""
    if pixels is None or not len(pixels):
        return np.zeros(2, dtype=int), (0, 0)
    wide = pixels.astype(np.int64)
    low = wide.min(axis=0)
    rows, cols = (wide.max(axis=0) - low + 1).tolist()
    return low, (rows, cols)
