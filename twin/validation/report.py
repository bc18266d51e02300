"""The demo's report: the claims, the paper's figures 7 to 15 as they came out here, and all specimens against truth."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.collections import LineCollection

from greenough.pipeline.report import calibration_figures, colours
from greenough.pipeline.report.cloud_figures import error_panels, height_panel, picture_panel, rms, uncertainty_panels
from greenough.pipeline.report.figures import (
    FAINT,
    FIRST,
    SECOND,
    THIRD,
    Panel,
    graph,
    histogram,
)
from greenough.pipeline.report.lead import relief_figure, verdict_lead
from greenough.pipeline.report.map_panels import map_panel
from greenough.pipeline.report.page import Figure, Page, Section, write_page
from greenough.pipeline.report.results import CLAIMS_TEXT, SHOWN_FIRST, calibration_sections, summary_of_claims
from greenough.pipeline.report.surface_view import Layer, SurfaceView, error_layer, uncertainty_layer
from greenough.pipeline.report.tables import Cell, Row, Table, claims_table, facts_table, fixed, text_of

from .claims import Claim, environment
from .noise import PlaneNoise, paper_line
from .pitch import MeasuredBoard, all_pairs
from .setup import Setup
from .specimen_maps import CALIBRATION_STEP_PX, SpecimenMaps
from .verdict import verdict_of

PAPER_ROW, PAPER_COL = 200, 300
"""Row and column of the diaphragm's maps whose profiles the paper shows."""


def write_report(
    path: Path,
    claims: Sequence[Claim],
    setup: Setup,
    plane: PlaneNoise,
    board: MeasuredBoard,
    specimens: Sequence[SpecimenMaps],
    facts: Mapping[str, Any],
    pictures: Path | None = None,
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
    board : MeasuredBoard
        The board of the calibration in a new posture.
    specimens : sequence of SpecimenMaps
    facts : mapping
        More of what the figures were made with, such as the rig and its settings.
    pictures : Path, optional
        Folder for the figures as PNG.
    """
    for_papers = pictures is not None
    rows = [asdict(claim) for claim in claims]
    wrong = [row for row, claim in zip(rows, claims, strict=True) if not claim.as_expected]
    judged = sum(claim.holds is not None for claim in claims)
    lines = verdict_of(claims).plain
    page = Page(
        title="Claims and measurements",
        summary=summary_of_claims(len(rows), judged, wrong, lines),
        sections=[
            Section("Claims", CLAIMS_TEXT, tables=[claims_table(rows)]),
            *calibration_part(setup, for_papers),
            plane_section(plane, setup.filter_name, for_papers),
            board_section(board, setup, for_papers),
            *specimen_sections(specimens, for_papers),
            Section("Made with", tables=[facts_table(_made_with(setup, facts), "What the figures were made with")]),
        ],
        surfaces=[_surface(maps) for maps in _best(specimens)],
        alarm=bool(wrong),
        lead=verdict_lead(lines, _relief(specimens, for_papers), for_papers),
    )
    write_page(path, page, pictures)


def calibration_part(setup: Setup, for_papers: bool) -> list[Section]:
    """The patterns, and what the calibration says about itself."""
    calibration = setup.calibration
    patterns = calibration_figures.patterns_figure(calibration.fringes, setup.rig.projector.shape, for_papers)
    return [Section("Patterns", figures=[patterns]), *calibration_sections(calibration, for_papers)]


def plane_section(plane: PlaneNoise, filter_name: str, for_papers: bool) -> Section:
    """What one exposure of a plane scatters by: the paper's figure 11."""
    panels: list[Panel] = []
    raw, filtered = 1e3 * plane.raw, 1e3 * plane.filtered
    row, reach = paper_line(len(raw)), colours.reach(raw)
    if plane.phase is not None:
        phase = np.where(np.isfinite(raw), plane.phase, np.nan)
        map_panel(
            panels, "plane-phase", "absolute phase", phase, "phase (rad)", colours.HEIGHT, *colours.ends(phase, 99.9),
            for_papers, rows=[row],
        )  # fmt: skip
    for values, which in ((raw, "unfiltered"), (filtered, "filtered")):
        limit = colours.reach(values)
        map_panel(
            panels, f"plane-{which}", f"departure from the best plane, {which}", values, "departure (µm)",
            colours.ERROR, -limit, limit, for_papers, rows=[row],
        )  # fmt: skip
    with graph(
        panels,
        "plane-profile",
        f"image row {row}, dashed in the maps",
        "column (px)",
        "departure (µm)",
        f"Departure along image row {row}",
        for_papers,
    ) as axes:
        seen = np.flatnonzero(np.isfinite(raw[row]))
        axes.plot(raw[row], color=FAINT, linewidth=0.5, label="unfiltered")
        axes.plot(filtered[row], color=FIRST, label="filtered")
        axes.set_ylim(-1.5 * reach, 1.9 * reach)
        if len(seen):
            axes.set_xlim(seen[0], seen[-1])
        axes.legend(loc="upper right", ncols=2)
    with graph(
        panels,
        "plane-histogram",
        f"RMS {rms(raw):.2f} µm, filtered {rms(filtered):.2f} µm",
        "",
        "",
        "Histogram of the departures",
        for_papers,
    ) as axes:
        histogram(axes, [("unfiltered", raw, FAINT), ("filtered", filtered, FIRST)], reach, "departure (µm)")
    caption = (
        f"One exposure, aligned to its own best plane. Filtered: {filter_name}. The paper shows row {row} as well. "
        "Colours end at the 99th percentile of the absolute values."
    )
    return Section("Plane", figures=[Figure(panels, caption)])


def board_section(board: MeasuredBoard, setup: Setup, for_papers: bool) -> Section:
    """Spot centres in space and the distances of neighbours: the paper's figure 12."""
    panels: list[Panel] = []
    bright = max(colours.ends(board.background, 99.5)[1], 1.0)
    map_panel(
        panels, "board-picture", "the board in a new posture, spots found", board.background, "DN above black",
        colours.LIGHT, 0.0, bright, for_papers, spots=board.spots.centres_px[board.spots.seen],
    )  # fmt: skip
    points, nominal = board.points[0], setup.calibration.board.pitch_mm
    pairs = all_pairs(setup.calibration.board)
    ends = points[pairs]  # (pairs, 2, 3)
    ends = ends[np.isfinite(ends).all(axis=(1, 2))]
    error = 1e3 * (np.linalg.norm(ends[:, 1] - ends[:, 0], axis=-1) - nominal)
    limit = colours.reach(error)
    low, high = colours.ends(points[:, 2])
    for axis, name in ((1, "y"), (2, "z")):
        with graph(
            panels,
            f"board-centres-{name}",
            f"centres in space, x and {name}",
            "x (mm)",
            f"{name} (mm)",
            f"Spot centres, x and {name}",
            for_papers,
        ) as axes:
            links = LineCollection(
                list(ends[..., [0, axis]]), colors=colormaps[colours.ERROR](0.5 + 0.5 * error / limit), linewidths=2.0
            )
            axes.add_collection(links)
            axes.plot(points[:, 0], points[:, axis], "o", color=FIRST, markersize=2.6, markeredgewidth=0)
            if axis == 1:
                axes.set_aspect("equal", adjustable="datalim")
    mean, sd = (float(error.mean()), float(error.std(ddof=1))) if len(error) > 1 else (np.nan, np.nan)
    title = f"mean {nominal + 1e-3 * mean:.5f} mm, sd {sd:.2f} µm, n = {len(error)}"
    with graph(panels, "board-distances", title, "", "", "Distances of neighbouring spots", for_papers) as axes:
        counts, edges = np.histogram(error, bins=40)
        axes.stairs(counts, edges, color=FIRST, fill=True, alpha=0.35)
        axes.set(xlabel=f"distance less {nominal:g} mm (µm)", ylabel="pairs")
        axes.axvline(0, color=FAINT, linewidth=0.8, linestyle=(0, (4, 3)))
    caption = (
        f"Spots of the calibration's board in a posture that it has not seen; heights from {fixed(low, 2)} to "
        f"{fixed(high, 2)} mm. Links are red where neighbours are farther apart than {nominal:g} mm and blue where "
        f"they are nearer, in full colour at {limit:.2f} µm; the print's own errors are in it. Phase averaged over "
        "each spot; no alignment."
    )
    return Section("Distances on the board", figures=[Figure(panels, caption)])


def specimen_sections(specimens: Sequence[SpecimenMaps], for_papers: bool) -> Iterator[Section]:
    """A section for each specimen and treatment, and one for what the diaphragm's states say together."""
    for maps in specimens:
        figures = [specimen_figure(maps, for_papers)]
        tables: list[Table] = []
        if maps.balls_mm is not None:
            figures.append(section_of_balls(maps, for_papers))
            tables.append(ball_table(maps.balls_mm))
        yield Section(maps.title, figures=figures, tables=tables)
    states = [maps for maps in specimens if maps.name.startswith("diaphragm")]
    if states:
        yield Section("Diaphragm in its states", figures=[diaphragm_figure(states, for_papers)])


def specimen_figure(maps: SpecimenMaps, for_papers: bool) -> Figure:
    """Picture, height, error and uncertainty: the paper's figures 13 to 15, and what it could not show."""
    panels: list[Panel] = []
    stem = maps.stem
    picture_panel(panels, stem, maps.background, maps.origin, for_papers)
    height_panel(panels, stem, maps.height_mm, maps.origin, for_papers)
    error_panels(panels, stem, maps.error_um, maps.smooth, maps.origin, for_papers, ("smooth", "not smooth"))
    sigmas = [
        (title, values, step)
        for title, values, step in (
            ("σ z by noise", maps.sigma_noise_um, 1),
            ("σ z by the calibration", maps.sigma_calibration_um, CALIBRATION_STEP_PX),
        )
        if values is not None
    ]
    uncertainty_panels(panels, stem, sigmas, maps.origin, for_papers)
    caption = (
        f"Filter: {maps.filter}. In the calibrated frame without any alignment. Error: vertical, against the surface "
        "that was rendered, where it is lit and seen; faded: not smooth over an Airy disc, so that it does not count "
        "in bias and RMSE. Colours end at the 99th percentile. σ z: standard uncertainty of the height."
    )
    return Figure(panels, caption)


def section_of_balls(maps: SpecimenMaps, for_papers: bool) -> Figure:
    """A cross-section along the middle row of balls, and the apexes' errors."""
    panels: list[Panel] = []
    assert maps.balls_mm is not None
    # The middle row of balls is where, near the middle, most of a picture's row is high above the substrate.
    z = maps.height_mm
    low, high = colours.ends(z)
    near = np.arange(len(z) // 3, max(len(z) // 3 + 1, 2 * len(z) // 3))
    row = int(near[np.argmax(np.sum(z[near] > low + 0.8 * (high - low), axis=1))])
    with graph(
        panels,
        f"{maps.stem}-section",
        f"section along image row {maps.origin[0] + row}",
        "x (mm)",
        "z (mm)",
        "Section through a row of balls",
        for_papers,
    ) as axes:
        axes.plot(maps.xyz[row, :, 0], z[row], "o", color=FIRST, markersize=1.8, markeredgewidth=0)
        room = 0.15 * (high - low)
        axes.set_ylim(low - room, high + room)
    error = 1e3 * (maps.balls_mm[:, 0] - maps.balls_mm[:, 1])
    with graph(
        panels,
        f"{maps.stem}-apexes",
        f"apexes, RMSE {rms(error):.2f} µm",
        "ball",
        "error of the apex height (µm)",
        "Errors of the apexes' heights",
        for_papers,
    ) as axes:
        axes.plot(np.arange(len(error)), error, "o", color=FIRST, markersize=2.8, markeredgewidth=0)
        axes.axhline(0, color=FAINT, linewidth=0.8)
    return Figure(
        panels, f"Filter: {maps.filter}. Apex: top of a paraboloid over 15° of the ball, above the substrate."
    )


def ball_table(balls_mm: np.ndarray) -> Table:
    """Heights of all balls, measured and true."""
    rows = [
        Row(
            [
                Cell(str(k)),
                *(Cell(fixed(1e3 * float(height), 2)) for height in (measured, true, measured - true)),
            ]
        )
        for k, (measured, true) in enumerate(balls_mm)
    ]
    columns = ("ball", "height (µm)", "true height (µm)", "error (µm)")
    return Table("Balls", columns, rows, frozenset(columns[1:]), tall=True)


def diaphragm_figure(states: Sequence[SpecimenMaps], for_papers: bool) -> Figure:
    """Profiles of all states along one row and one column: the paper's figure 15."""
    panels: list[Panel] = []
    row, col = (  # in a coarser picture the middle, where the paper's is not in it
        at if at < n else n // 2 for at, n in zip((PAPER_ROW, PAPER_COL), states[0].height_mm.shape, strict=True)
    )
    styles = (FIRST, THIRD, SECOND)
    low, high = colours.ends(np.concatenate([maps.height_mm.ravel() for maps in states]))
    room = 0.08 * (high - low)
    v, u = states[0].origin[0] + row, states[0].origin[1] + col
    for what, axis, title in ((0, "row", f"image row {v}"), (1, "column", f"image column {u}")):
        with graph(
            panels,
            f"diaphragm-{axis}",
            title,
            f"{'x' if what == 0 else 'y'} (mm)",
            "z (mm)",
            f"Heights along {title}",
            for_papers,
        ) as axes:
            for maps, colour in zip(states, styles, strict=False):
                dv, du = v - maps.origin[0], u - maps.origin[1]
                line = maps.xyz[dv] if what == 0 else maps.xyz[:, du]
                axes.plot(line[:, what], line[:, 2], color=colour, label=maps.name.removeprefix("diaphragm-"))
            axes.set_ylim(low - room, high + 3.5 * room)
            axes.legend(loc="upper center", ncols=3)
    caption = (
        f"Row {row} and column {col}, counted from the first of the first state's map; the paper shows {PAPER_ROW} and "
        f"{PAPER_COL}. Filter: {states[0].filter}; no alignment."
    )
    return Figure(panels, caption)


def _best(specimens: Sequence[SpecimenMaps]) -> list[SpecimenMaps]:
    """The last treatment of every specimen: metal and solder deconvolved, where they could be."""
    return list({maps.name: maps for maps in specimens}.values())


def _relief(specimens: Sequence[SpecimenMaps], for_papers: bool) -> Figure | None:
    """The specimen that the page opens with."""
    best = {maps.name: maps for maps in _best(specimens)}
    maps = next((best[name] for name in SHOWN_FIRST if name in best), None)
    if maps is None:
        return None
    return relief_figure(
        maps.stem, maps.name, maps.xyz, maps.origin, f"Filter: {maps.filter}; alignment: none.", for_papers
    )


def _surface(maps: SpecimenMaps) -> SurfaceView:
    layers: list[Layer] = [error_layer(maps.error_um)]
    if np.any(maps.counts):
        limit = colours.reach(maps.error_um[maps.counts])
        layers = [Layer("error", "µm", maps.error_um, -limit, limit, colours.ERROR, 1)]
    if maps.sigma_noise_um is not None:
        layers.append(uncertainty_layer("σ z by noise", maps.sigma_noise_um))
    if maps.sigma_calibration_um is not None:
        step = CALIBRATION_STEP_PX
        whole = maps.sigma_calibration_um.repeat(step, axis=0).repeat(step, axis=1)
        rows, cols = maps.height_mm.shape
        layers.append(uncertainty_layer("σ z by calibration", whole[:rows, :cols]))
    note = f"Filter: {maps.filter}; alignment: none. Error: vertical, against the surface that was rendered."
    return SurfaceView(maps.title, maps.xyz, layers, note, maps.origin)


def _made_with(setup: Setup, facts: Mapping[str, Any]) -> dict[str, Any]:
    where = environment()
    procedure, optics = setup.calibration.procedure, setup.bench.settings.optics
    rows, cols = setup.calibration.camera.shape
    return {
        **facts,
        "instrument's seed": str(setup.bench.settings.seed),
        "settings, SHA-256": setup.rig.identity.settings_sha256,
        "camera": f"{cols} x {rows} px of {1e3 * optics.pupil_distance_mm / optics.camera_focal_px:.2f} µm "
        f"on the specimen, Airy radius {setup.airy_radius_px:.2f} px",
        "fringes": f"periods {text_of(procedure.periods_px)} px, steps {text_of(procedure.steps)}",
        "calibration": f"{setup.calibration.figures['method']} method, {procedure.postures} postures, "
        f"{procedure.planes} planes {1e3 * procedure.plane_step_mm:g} µm apart, run {setup.calibration.run!r}",
        "written": datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
        "with": where["packages"],
        "on": f"Python {where['python']}, {where['platform']}, {where['cpus']} CPUs",
    }
