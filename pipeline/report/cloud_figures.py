"""What was measured of a part, as figures: heights, errors against a mesh, uncertainties."""

from collections.abc import Sequence

import numpy as np

from . import colours
from .figures import FAINT, FIRST, Panel, graph, histogram
from .map_panels import map_panel
from .page import Figure
from .surface_view import BRIGHTNESS
from .tables import fixed


def picture_panel(panels: list[Panel], stem: str, light: np.ndarray, origin: tuple[int, int], for_papers: bool) -> None:
    """The camera's picture (rows, cols), DN above black."""
    map_panel(
        panels, f"{stem}-picture", "camera's picture", light, "DN above black", colours.LIGHT, 0.0,
        max(colours.ends(light, 99.5)[1], 1.0), for_papers, origin=origin,
    )  # fmt: skip


def height_panel(
    panels: list[Panel], stem: str, z_mm: np.ndarray, origin: tuple[int, int], for_papers: bool, step: int = 1
) -> None:
    """Heights (rows, cols) in mm between their 1st and 99th percentile."""
    low, high = colours.ends(z_mm)
    map_panel(
        panels, f"{stem}-height", "measured height", z_mm, "z (mm)", colours.HEIGHT, low, high, for_papers,
        origin=origin, step=step,
    )  # fmt: skip


def error_panels(
    panels: list[Panel],
    stem: str,
    error_um: np.ndarray,
    counts: np.ndarray,
    origin: tuple[int, int],
    for_papers: bool,
    what: tuple[str, str] = ("counted", "not counted"),
) -> None:
    """Map and histogram of errors (rows, cols) in µm; those that do not count are faded, and have their own curve."""
    judged = error_um[counts & np.isfinite(error_um)]
    limit = colours.reach(judged)
    map_panel(
        panels, f"{stem}-error", "vertical error", error_um, "error (µm)", colours.ERROR, -limit, limit, for_papers,
        counts=counts, origin=origin,
    )  # fmt: skip
    mean = float(judged.mean()) if len(judged) else np.nan
    with graph(
        panels,
        f"{stem}-error-histogram",
        f"bias {fixed(mean, 2)} µm, RMSE {fixed(rms(judged), 2)} µm",
        "",
        "",
        "Histogram of the errors",
        for_papers,
    ) as axes:
        samples = [(what[0], judged, FIRST)]
        rest = error_um[~counts]
        if np.isfinite(rest).any():
            samples.append((what[1], rest, FAINT))
        histogram(axes, samples, limit, "vertical error (µm)")


def uncertainty_panels(
    panels: list[Panel],
    stem: str,
    sigmas_um: Sequence[tuple[str, np.ndarray, int]],
    origin: tuple[int, int],
    for_papers: bool,
) -> None:
    """Maps of standard uncertainties: title, values (rows, cols) in µm and camera pixels from one to the next."""
    for k, (title, values, step) in enumerate(sigmas_um):
        map_panel(
            panels, f"{stem}-sigma-{k}", title, values, "µm", colours.UNCERTAINTY, 0.0, colours.ends(values)[1],
            for_papers, origin=origin, step=step,
        )  # fmt: skip


def cloud_figures(
    stem: str, xyz: np.ndarray, layers: dict[str, np.ndarray], counts: np.ndarray | None, origin: tuple[int, int],
    for_papers: bool,
) -> list[Figure]:  # fmt: skip
    """The figures of a cloud on its grid, (rows, cols, 3) mm, with its layers of errors and uncertainties in µm."""
    panels: list[Panel] = []
    if BRIGHTNESS in layers:
        picture_panel(panels, stem, layers[BRIGHTNESS], origin, for_papers)
    height_panel(panels, stem, xyz[..., 2], origin, for_papers)
    caption = "Every point as it was measured, in the calibrated frame."
    if "error" in layers:
        everywhere = np.ones(xyz.shape[:2], dtype=bool)
        error_panels(
            panels, stem, layers["error"], everywhere if counts is None else counts, origin, for_papers,
            ("all points" if counts is None else "smooth", "not smooth"),
        )  # fmt: skip
        caption += (
            " Error: z less that of the mesh's uppermost surface on the same (x, y); colours end at the "
            "99th percentile."
        )
    sigmas = [(name, values, 1) for name, values in layers.items() if name.startswith("σ")]
    uncertainty_panels(panels, stem, sigmas, origin, for_papers)
    if sigmas:
        caption += " σ z: standard uncertainty of the height, by noise and by the calibration."
    return [Figure(panels, caption)]


def rms(values: np.ndarray) -> float:
    """Root mean square of the finite values; NaN without any."""
    seen = values[np.isfinite(values)].astype(np.float64)
    return float(np.sqrt(np.mean(seen**2))) if len(seen) else np.nan
