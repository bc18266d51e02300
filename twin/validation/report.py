"""The demo's report: one page that stands alone, the claims as a table and what lies behind them as maps."""

import base64
import io
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.resources import files
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from greenough.instrument.files import atomic_path

from .claims import Claim, environment
from .noise import PlaneNoise, paper_line
from .setup import Setup
from .specimens import RAW, Measured

SCALE_PERCENTILE = 99.0
"""The colour scale of an error map ends at this percentile of the absolute errors where the surface is smooth."""

HEIGHT_COLOURS, ERROR_COLOURS = "viridis", "RdBu_r"
DPI = 110
_UNKNOWN = 0.55  # grey of pixels without a point
_FADED = 0.65  # share of light grey in the colour of errors that do not count
_MARGIN_PX = 10


@dataclass(frozen=True, eq=False)
class SpecimenMaps:
    """What the report shows of one specimen; all arrays are (rows, cols).

    Parameters
    ----------
    name : str
    background : float32
        The picture under even light, DN above black.
    height_mm : float32
        Measured z, NaN where there is no point.
    error_um : float32
        Vertical error, NaN where there is no point or truth does not call the pixel lit and seen.
    smooth : bool
        Where errors count.
    """

    name: str
    background: np.ndarray
    height_mm: np.ndarray
    error_um: np.ndarray
    smooth: np.ndarray


def specimen_maps(measured: Measured) -> SpecimenMaps:
    """The maps of a measured specimen.

    Point and truth lie on one camera ray, some µm apart: the vertical error is taken to the tangent plane at the true
    point, which is the surface itself as far as it is smooth.
    """
    truth = measured.truth
    normal = truth.normal_world
    with np.errstate(divide="ignore", invalid="ignore"):
        error = np.einsum("rci,rci->rc", measured.points.xyz - truth.xyz_world, normal) / normal[..., 2]
    return SpecimenMaps(
        name=measured.name if measured.treatment == RAW else f"{measured.name}, {measured.treatment}",
        background=measured.background.astype(np.float32),
        height_mm=measured.points.xyz[..., 2].astype(np.float32),
        error_um=np.where(truth.lit_and_seen, 1e3 * error, np.nan).astype(np.float32),
        smooth=measured.smooth,
    )


def write_report(
    path: Path,
    claims: Sequence[Claim],
    setup: Setup,
    plane: PlaneNoise,
    specimens: Sequence[SpecimenMaps],
    facts: Mapping[str, Any],
) -> None:
    """Write the report; it appears whole or not at all.

    Parameters
    ----------
    path : Path
        The HTML file. Its pictures are inside it.
    claims : sequence of Claim
    setup : Setup
        Whose figures they are.
    plane : PlaneNoise
    specimens : sequence of SpecimenMaps
    facts : mapping
        More for the header, such as the rig and its settings.
    """
    template = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    ).from_string(files("greenough.twin.validation").joinpath("report.html").read_text(encoding="utf-8"))
    page = template.render(
        header=_header(setup, facts),
        claims=claims,
        judged=[claim for claim in claims if claim.holds is not None],
        unexpected=[claim for claim in claims if not claim.as_expected],
        figures=_figures(plane, setup.filter_name, specimens),
        calibration={name.replace("_", " "): _text(value) for name, value in setup.calibration.figures.items()},
        number=_text,
    )
    with atomic_path(path) as temporary:
        temporary.write_text(page, encoding="utf-8")


def _header(setup: Setup, facts: Mapping[str, Any]) -> dict[str, str]:
    where = environment()
    procedure, optics = setup.calibration.procedure, setup.bench.settings.optics
    rows, cols = setup.calibration.camera.shape
    return {
        **{name: _text(value) for name, value in facts.items()},
        "instrument's seed": str(setup.bench.settings.seed),
        "settings, SHA-256": setup.rig.identity.settings_sha256,
        "camera": f"{cols} x {rows} px of {1e3 * optics.pupil_distance_mm / optics.camera_focal_px:.2f} µm "
        f"on the specimen, Airy radius {setup.airy_radius_px:.2f} px",
        "fringes": f"periods {_text(procedure.periods_px)} px, steps {_text(procedure.steps)}",
        "calibration": f"{setup.calibration.figures['method']} method, {procedure.postures} postures, "
        f"{procedure.planes} planes {1e3 * procedure.plane_step_mm:g} µm apart, run {setup.calibration.run!r}",
        "written": datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
        "with": ", ".join(f"{name} {version}" for name, version in where["packages"].items()),
        "on": f"Python {where['python']}, {where['platform']}, {where['cpus']} CPUs",
    }


def _figures(plane: PlaneNoise, filter_name: str, specimens: Sequence[SpecimenMaps]) -> Iterator[dict[str, str]]:
    """One figure after the other, so that only one is in memory."""
    yield {"title": "Plane", "picture": _data_uri(_plane_figure(plane)), "caption": _plane_caption(filter_name)}
    for maps in specimens:
        yield {"title": maps.name, "picture": _data_uri(_specimen_figure(maps)), "caption": _SPECIMEN_CAPTION}


def _plane_caption(filter_name: str) -> str:
    return (
        f"One exposure. Map and blue curves: {filter_name}. Grey: unfiltered. The colours end at the "
        f"{SCALE_PERCENTILE:g}th percentile of the absolute values."
    )


_SPECIMEN_CAPTION = (
    "Unfiltered, in the calibrated frame without any alignment. Error: vertical, against the surface that was "
    f"rendered. Colours end at the {SCALE_PERCENTILE:g}th percentile of the absolute errors on smooth surface; faded "
    "colours: lit and seen, but not smooth over an Airy disc, so they do not count in bias, RMSE and p95; grey: no "
    "point."
)


def _plane_figure(plane: PlaneNoise) -> Figure:
    figure = Figure(figsize=(10.5, 6.4), dpi=DPI, layout="constrained")
    axes = figure.subplot_mosaic(
        [["map", "histogram"], ["line", "line"]], width_ratios=[1.5, 1], height_ratios=[1.5, 1]
    )
    raw, filtered = 1e3 * plane.raw, 1e3 * plane.filtered
    window = _window(np.isfinite(raw))
    limit = _percentile(filtered)
    _show_errors(axes["map"], filtered, np.isfinite(filtered), limit, window)
    axes["map"].set_title("departure from the best plane, filtered")
    row = paper_line(len(raw))
    axes["map"].axhline(row, color="black", linewidth=0.6, linestyle="--")
    reach = _percentile(raw)
    _histogram(axes["histogram"], ("unfiltered", raw), ("filtered", filtered), reach)
    title = f"RMS unfiltered {_rms(raw):.2f} µm, filtered {_rms(filtered):.2f} µm"
    axes["histogram"].set(title=title, xlabel="departure (µm)")
    axes["line"].plot(raw[row], color="0.6", linewidth=0.6, label="unfiltered")
    axes["line"].plot(filtered[row], color="tab:blue", linewidth=1.0, label="filtered")
    axes["line"].set(
        title=f"image row {row}, dashed in the map", xlabel="column u (px)", ylabel="departure (µm)",
        xlim=(window[1].start, window[1].stop), ylim=(-1.5 * reach, 1.5 * reach),
    )  # fmt: skip
    axes["line"].grid(alpha=0.3)
    axes["line"].legend(loc="upper right", ncols=2)
    return figure


def _specimen_figure(maps: SpecimenMaps) -> Figure:
    figure = Figure(figsize=(10.5, 7.2), dpi=DPI, layout="constrained")
    (picture, height), (error, histogram) = figure.subplots(2, 2)
    window = _window(np.isfinite(maps.height_mm))
    counts = maps.smooth & np.isfinite(maps.error_um)
    bright = float(np.percentile(maps.background, 99.5))
    _image(picture, maps.background, window, "gray", Normalize(0, bright or 1), "background (DN above black)")
    picture.set_title("camera's picture")
    low, high = _ends(maps.height_mm)
    _image(height, maps.height_mm, window, HEIGHT_COLOURS, Normalize(low, high), "z (mm)")
    height.set_title("measured height")
    limit = _percentile(maps.error_um[counts])
    _show_errors(error, maps.error_um, counts, limit, window)
    error.set_title("error")
    judged = maps.error_um[counts]
    _histogram(histogram, ("smooth", judged), ("not smooth", maps.error_um[~maps.smooth]), limit)
    mean = float(judged.mean()) if len(judged) else np.nan
    histogram.axvline(mean, color="black", linewidth=0.8, linestyle="--")
    histogram.set(title=f"smooth: bias {mean:.2f} µm (dashed), RMSE {_rms(judged):.2f} µm", xlabel="error (µm)")
    return figure


def _image(
    axes: Axes, values: np.ndarray, window: tuple[slice, slice], colours: str, norm: Normalize, label: str
) -> None:
    colour_map = colormaps[colours].with_extremes(bad=str(_UNKNOWN))
    # No resampling: averaging neighbours would show less noise than there is.
    image = axes.imshow(values[window], cmap=colour_map, norm=norm, extent=_extent(window), interpolation="nearest")
    assert axes.figure is not None
    axes.figure.colorbar(image, ax=axes, label=label, shrink=0.85)
    axes.set(xlabel="column u (px)", ylabel="row v (px)")


def _show_errors(
    axes: Axes, error_um: np.ndarray, counts: np.ndarray, limit: float, window: tuple[slice, slice]
) -> None:
    """An error map in diverging colours, faded where the errors do not count."""
    norm = Normalize(-limit, limit)
    _image(axes, error_um, window, ERROR_COLOURS, norm, "error (µm)")
    shown, judged = error_um[window], counts[window]
    colours = colormaps[ERROR_COLOURS](norm(np.nan_to_num(shown)))
    colours[~judged, :3] = (1 - _FADED) * colours[~judged, :3] + _FADED * 0.85
    colours[~np.isfinite(shown), :3] = _UNKNOWN
    axes.images[0].remove()
    axes.imshow(colours, extent=_extent(window), interpolation="nearest")


def _histogram(axes: Axes, filled: tuple[str, np.ndarray], outlined: tuple[str, np.ndarray], limit: float) -> None:
    """Two labelled samples over one and a half times ``limit``."""
    most = 1.0
    for (label, values), fill, colour in ((filled, True, "0.7"), (outlined, False, "tab:blue")):
        seen = values[np.isfinite(values)]
        beyond = float(np.mean(np.abs(seen) > 1.5 * limit)) if len(seen) else 0.0
        label = f"{label}, n = {_text(len(seen))}" + (f", {100 * beyond:.2g} % beyond the axis" if beyond else "")
        span = (-1.5 * limit, 1.5 * limit)
        counts, edges = np.histogram(seen, bins=120, range=span)
        axes.stairs(counts, edges, fill=fill, color=colour, label=label)
        most = max(most, float(np.max(counts)))
    # Tails are what matters; the room above keeps the legend off the curves.
    axes.set(ylabel="pixels", xlim=(-1.5 * limit, 1.5 * limit), ylim=(0.8, 30 * most))
    axes.set_yscale("log")
    axes.grid(alpha=0.3)
    axes.legend(loc="upper left", fontsize="small")


def _window(wanted: np.ndarray) -> tuple[slice, slice]:
    """Rows and columns that hold everything wanted, with a margin; the whole picture where nothing is."""
    rows, cols = np.flatnonzero(wanted.any(axis=1)), np.flatnonzero(wanted.any(axis=0))
    if len(rows) == 0:
        return slice(0, wanted.shape[0]), slice(0, wanted.shape[1])
    down, across = (
        slice(max(0, int(seen[0]) - _MARGIN_PX), min(length, int(seen[-1]) + 1 + _MARGIN_PX))
        for seen, length in zip((rows, cols), wanted.shape, strict=True)
    )
    return down, across


def _extent(window: tuple[slice, slice]) -> tuple[float, float, float, float]:
    """Pixel centres at integers, rows downwards."""
    rows, cols = window
    return cols.start - 0.5, cols.stop - 0.5, rows.stop - 0.5, rows.start - 0.5


def _ends(values: np.ndarray) -> tuple[float, float]:
    seen = values[np.isfinite(values)]
    low, high = np.percentile(seen, [1, 99]) if len(seen) else (0.0, 1.0)
    return float(low), float(high)


def _percentile(values: np.ndarray) -> float:
    seen = np.abs(values[np.isfinite(values)])
    return float(np.percentile(seen, SCALE_PERCENTILE)) or 1.0 if len(seen) else 1.0


def _rms(values: np.ndarray) -> float:
    seen = values[np.isfinite(values)].astype(np.float64)
    return float(np.sqrt(np.mean(seen**2))) if len(seen) else np.nan


def _data_uri(figure: Figure) -> str:
    """The figure as PNG in a data URI. A figure without pyplot is drawn by Agg and freed with its last reference."""
    png = io.BytesIO()
    figure.savefig(png, format="png", bbox_inches="tight", pad_inches=0.05)
    return "data:image/png;base64," + base64.b64encode(png.getvalue()).decode("ascii")


def _text(value: Any) -> str:
    if value is None:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int):
        return f"{value:,}".replace(",", "\u202f")
    if isinstance(value, float):
        return f"{value:.5g}".replace("-", "−")
    if isinstance(value, list | tuple):
        return ", ".join(_text(item) for item in value) or "–"
    return str(value)
