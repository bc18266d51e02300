"""What a calibration says about itself, as figures: spots, reprojection, phase and height, planes, uncertainty."""

import numpy as np
from matplotlib.patches import Rectangle

from ..calibration import Calibration
from ..fringes import FringeSet
from . import colours
from .figures import (
    ACCENT,
    FAINT,
    FIRST,
    FOURTH,
    SECOND,
    THIRD,
    Panel,
    graph,
    histogram,
)
from .map_panels import map_panel
from .page import Figure

CURVES = 4
"""Pixels whose relation of phase and height is shown, as many as in the paper; chosen at random, by a fixed seed."""

_GAP = 1.08  # pictures from one to the next in the sheet of postures
_MARGIN_PX = 40  # around the spots
_EVERY_PX = 16  # pixels of the map of the calibration's uncertainty


def patterns_figure(fringes: FringeSet, shape: tuple[int, int], for_papers: bool) -> Figure:
    """The first pattern of each period, as the projector of ``shape`` (rows, cols) shows it."""
    panels: list[Panel] = []
    patterns = fringes.patterns(*shape)
    firsts = np.concatenate([[0], np.cumsum(fringes.steps)[:-1]])
    bands = np.array_split(np.arange(shape[0]), len(firsts))
    sheet = np.concatenate([patterns[first][band] for first, band in zip(firsts, bands, strict=True)])
    map_panel(
        panels, "patterns", "first pattern of each period", sheet.astype(np.float32), "grey level", colours.LIGHT,
        0.0, 255.0, for_papers,
    )  # fmt: skip
    with graph(
        panels, "pattern-rows", "grey levels along a row", "column (px)", "grey level", "Grey levels of the patterns",
        for_papers,
    ) as axes:  # fmt: skip
        styles = (FIRST, SECOND, THIRD, FOURTH)
        for k, (first, period) in enumerate(zip(firsts, fringes.periods, strict=True)):
            axes.plot(patterns[first][0], color=styles[k % len(styles)], linewidth=0.8, label=f"{period:g} px")
        axes.set(xlim=(0, min(shape[1], 160) - 1), ylim=(-5, 320))
        axes.legend(loc="upper center", ncols=len(firsts))
    return Figure(
        panels,
        f"What is projected: {len(patterns)} patterns of {shape[1]} x {shape[0]} mirrors, of the periods "
        f"{', '.join(f'{period:g}' for period in fringes.periods)} px in {', '.join(map(str, fringes.steps))} steps. "
        "Left, the first of each in a band of its own, from the coarsest down; each step shifts the fringes by the "
        "period over the number of steps.",
    )


def postures_figure(calibration: Calibration, for_papers: bool) -> Figure:
    """Spots as they were found in each posture: the paper's figure 8."""
    panels: list[Panel] = []
    centres = calibration.residuals.centres_px
    rows, cols = calibration.camera.shape
    across = int(np.ceil(np.sqrt(len(centres))))
    low, high = (f(centres.reshape(-1, 2), axis=0) for f in (np.nanmin, np.nanmax))
    low, high = np.maximum(low - _MARGIN_PX, -0.5), np.minimum(high + _MARGIN_PX, (cols - 0.5, rows - 0.5))
    board = calibration.board
    big = np.zeros(centres.shape[1], dtype=bool)
    big[[row * board.cols + col for row, col in board.big]] = True
    with graph(
        panels, "postures", "spots found in each posture", "", "", "Spots found in each posture", for_papers
    ) as axes:
        width, height = high - low
        for k, found in enumerate(centres):
            down, right = divmod(k, across)
            at = found - low + (right * _GAP * width, down * _GAP * height)
            corner = right * _GAP * width, down * _GAP * height
            axes.add_patch(Rectangle(corner, width, height, fill=False, edgecolor=FAINT, linewidth=0.5))
            axes.plot(*at[~big].T, "o", markersize=1.1, color=FIRST, markeredgewidth=0)
            axes.plot(*at[big].T, "o", markersize=2.2, color=ACCENT, markeredgewidth=0)
        down = -(-len(centres) // across)
        axes.set(xlim=(-5, across * _GAP * width), ylim=(down * _GAP * height, -5))
        axes.set_aspect("equal")
        axes.axis("off")
    seen = np.isfinite(centres[..., 0])
    with graph(
        panels, "coverage", "coverage of the picture, all postures", "column (px)", "row (px)",
        "Where in the picture spots were found", for_papers,
    ) as axes:  # fmt: skip
        axes.plot(*centres[seen].T, "o", markersize=1.6, color=FIRST, markeredgewidth=0)
        axes.set(xlim=(-0.5, cols - 0.5), ylim=(rows - 0.5, -0.5))
        axes.set_aspect("equal", adjustable="box")
    with graph(
        panels,
        "spots-per-posture",
        f"{seen.sum()} centres in {len(centres)} postures",
        "posture",
        "spots found",
        "How many spots were found in each posture",
        for_papers,
    ) as axes:
        axes.bar(np.arange(len(centres)), seen.sum(axis=1), color=FIRST, width=0.7)
    return Figure(
        panels,
        f"Centres of the board's {board.rows} x {board.cols} spots as found in each posture; each frame shows columns "
        f"{low[0]:.0f} to {high[0]:.0f} and rows {low[1]:.0f} to {high[1]:.0f} of the picture. The big spots are "
        "marked. Spots that are cut or not lit are left out. The last posture is the "
        "flat one, which carries the world's frame. No filter.",
    )


def reprojection_figure(calibration: Calibration, for_papers: bool) -> Figure:
    """What the spots' centres depart from the model by: the paper's figure 9."""
    panels: list[Panel] = []
    residuals = calibration.residuals.spots_px
    seen = np.isfinite(residuals[..., 0])
    u, v = residuals[seen].T
    rmse = [float(np.sqrt(np.mean(each**2))) if len(each) else np.nan for each in (u, v)]
    limit = 1.15 * float(np.abs(residuals[seen]).max()) if len(u) else 1.0
    with graph(
        panels,
        "reprojection",
        f"reprojection errors, n = {len(u)}",
        "column error (px)",
        "row error (px)",
        "Reprojection errors of all spots",
        for_papers,
    ) as axes:
        axes.plot(u, v, "o", markersize=1.7, color=FIRST, markeredgewidth=0, alpha=0.6)
        axes.set(xlim=(-limit, limit), ylim=(-limit, limit))
        axes.set_aspect("equal", adjustable="box")
    with graph(
        panels,
        "reprojection-histogram",
        f"RMSE {rmse[0]:.4f} px along columns, {rmse[1]:.4f} px along rows",
        "error (px)",
        "",
        "Histogram of the reprojection errors",
        for_papers,
    ) as axes:
        for values, colour, label in ((u, FIRST, "column"), (v, SECOND, "row")):
            counts, edges = np.histogram(values, bins=50, range=(-limit, limit))
            axes.stairs(counts, edges, color=colour, label=label)
        axes.set(ylabel="spots")
        axes.legend(loc="upper right")
    with graph(
        panels,
        "reprojection-by-posture",
        "RMSE of each posture",
        "posture",
        "RMSE (px)",
        "Reprojection error of each posture",
        for_papers,
    ) as axes:
        count = np.maximum(seen.sum(axis=1), 1)[:, None]
        by_posture = np.sqrt(np.sum(np.where(seen[..., None], residuals, 0.0) ** 2, axis=1) / count)
        for k, (colour, label) in enumerate(((FIRST, "column"), (SECOND, "row"))):
            axes.plot(by_posture[:, k], "o-", markersize=3, color=colour, label=label, linewidth=0.8)
        axes.set_ylim(0, 1.35 * float(by_posture.max()) or 1.0)
        axes.legend(loc="upper right", ncols=2)
    return Figure(
        panels,
        f"Found less projected centres, by the {calibration.method} method"
        + (", board as printed nominally." if calibration.method == "paper" else ", whose fit estimates the spots.")
        + " All spots of all postures; no filter.",
    )


def phase_height_figure(calibration: Calibration, for_papers: bool) -> Figure:
    """Phase and height at some pixels: the paper's figure 10."""
    panels: list[Panel] = []
    relation = calibration.phase_height
    v, u = np.nonzero(relation.valid)
    if len(u) == 0:
        return Figure((), "No pixel is calibrated.")
    span = relation.z_range[v, u, 1] - relation.z_range[v, u, 0]
    most = np.flatnonzero(span >= np.percentile(span, 50))
    chosen = np.sort(np.random.default_rng(10).choice(most, min(CURVES, len(most)), replace=False))
    curves = []
    for k in chosen:
        window = slice(int(v[k]), int(v[k]) + 1), slice(int(u[k]), int(u[k]) + 1)
        one = relation.of_pixels(window)
        low, high = one.z_range[0, 0]
        z = np.linspace(low, high, 31)
        phase = np.array([one.phase(np.full((1, 1), height))[0, 0] for height in z])
        curves.append((f"column {u[k]}, row {v[k]}", phase, z))
    styles = (FIRST, SECOND, THIRD, FOURTH)
    with graph(
        panels,
        "phase-height",
        f"phase and height in {len(curves)} pixels",
        "absolute phase (rad)",
        "z (mm)",
        "Phase and height at four pixels",
        for_papers,
    ) as axes:
        for (label, phase, z), colour in zip(curves, styles, strict=False):
            axes.plot(phase, z, "-", color=colour, label=label)
        low, high = axes.get_ylim()
        axes.set_ylim(low - 0.3 * (high - low), high)
        axes.legend(loc="lower center", ncols=2)
    with graph(
        panels,
        "phase-height-bend",
        "departure from a straight line",
        "z (mm)",
        "departure (µm)",
        "Departure of height from a straight line in phase",
        for_papers,
    ) as axes:
        for (label, phase, z), colour in zip(curves, styles, strict=False):
            axes.plot(z, 1e3 * (z - np.polyval(np.polyfit(phase, z, 1), phase)), color=colour, label=label)
    return Figure(
        panels,
        f"The calibrated relation of {len(curves)} pixels that were drawn at random, over the heights where each is "
        "calibrated; right, what a straight line would leave out.",
    )


def planes_figure(calibration: Calibration, for_papers: bool) -> Figure | None:
    """What the calibration's planes depart from it by; None for methods without planes."""
    residuals = calibration.residuals
    if len(residuals.planes_um) == 0:
        return None
    panels: list[Panel] = []
    low, high = 0.0, colours.ends(residuals.pixels_um)[1]
    map_panel(
        panels, "planes-pixels", "RMS over the planes, every pixel", residuals.pixels_um, "µm", colours.UNCERTAINTY,
        low, high, for_papers,
    )  # fmt: skip
    blocks = residuals.planes_um.reshape(len(residuals.planes_um), -1)
    with graph(
        panels,
        "planes",
        "residuals of blocks, by plane",
        "plane, from the lowest",
        "departure (µm)",
        "Residuals of the planes, mean and spread of blocks",
        for_papers,
    ) as axes:
        count = np.maximum(np.isfinite(blocks).sum(axis=1), 1)
        mean = np.nansum(blocks, axis=1) / count
        sd = np.sqrt(np.nansum((blocks - mean[:, None]) ** 2, axis=1) / count)
        axes.errorbar(
            np.arange(len(mean)), mean, sd, fmt="o", markersize=2.5, color=FIRST, elinewidth=0.8, ecolor=FAINT
        )
    with graph(
        panels,
        "planes-histogram",
        "means of blocks, all planes",
        "departure (µm)",
        "",
        "Histogram of the block means of all planes",
        for_papers,
    ) as axes:
        histogram(axes, [("blocks", blocks, FIRST)], colours.reach(blocks), "departure (µm)")
        axes.set_ylabel("blocks")
    return Figure(
        panels,
        "Heights of the calibration's planes less what the calibration makes of their phases: of each pixel, and of "
        "means over blocks of the picture. No filter besides these blocks; bars are one standard deviation.",
    )


def uncertainty_figure(calibration: Calibration, for_papers: bool) -> Figure:
    """How far the calibration may displace heights: over the picture in the middle of the volume, and over height."""
    panels: list[Panel] = []
    rows, cols = calibration.camera.shape
    v, u = np.mgrid[_EVERY_PX // 2 : rows : _EVERY_PX, _EVERY_PX // 2 : cols : _EVERY_PX]
    pixels = np.stack([u.ravel(), v.ravel()], axis=-1)
    heights = calibration.uncertainty.heights_mm
    middle = float(heights[len(heights) // 2])

    def sigma_z(z: float) -> np.ndarray:
        variance = calibration.uncertainty.covariance(pixels, np.full(len(pixels), z))[:, 2, 2]
        return 1e3 * np.where(calibration.phase_height.valid[v, u], np.sqrt(variance).reshape(u.shape), np.nan)

    sigmas = [sigma_z(float(z)) for z in heights]
    shown = sigmas[len(heights) // 2]
    map_panel(
        panels, "calibration-uncertainty", f"σ z by the calibration at z = {middle:.2f} mm", shown, "µm",
        colours.UNCERTAINTY, 0.0, colours.ends(shown)[1], for_papers, step=_EVERY_PX,
    )  # fmt: skip
    with graph(
        panels,
        "calibration-uncertainty-z",
        "σ z by the calibration, over height",
        "z (mm)",
        "σ z (µm)",
        "Calibration's uncertainty over height",
        for_papers,
    ) as axes:
        known = [each[np.isfinite(each)] for each in sigmas]
        if all(len(each) for each in known):
            for share, label, colour in ((50, "median", FIRST), (95, "95 %", SECOND)):
                axes.plot(heights, [np.percentile(each, share) for each in known], "o-", markersize=3, color=colour,
                          label=label)  # fmt: skip
            axes.legend(loc="best")
        axes.set_ylim(bottom=0)
        axes.axvline(middle, color=ACCENT, linewidth=0.7, linestyle=(0, (4, 3)))
    return Figure(
        panels,
        "Standard uncertainty of heights by calibration and drifts, which neighbouring points share; the frames' noise "
        f"comes on top. Computed in every {_EVERY_PX}th pixel.",
    )
