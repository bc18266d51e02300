"""The page of a result file: a cloud, a calibration, a table of claims or of acceptance, or a demo's folder."""

import json
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from greenough.instrument.errors import InputError
from greenough.instrument.file_errors import reading
from greenough.instrument.files import check_readable
from greenough.instrument.plain_table import first_few

from ..calibration import Calibration
from ..compare import Alignment, Surface, error_row, fit_motion, vertical_errors
from ..point_cloud import Mesh, PointCloud, read_cloud, read_mesh
from . import calibration_figures
from .cloud_figures import cloud_figures
from .lead import acceptance_lead, relief_figure, verdict_lead
from .page import Figure, Lead, Page, Section
from .surface_view import SurfaceView, view_of_cloud
from .tables import Table, acceptance_table, claims_table, facts_table, fixed, is_as_expected, text_of
from .verdict_table import verdict_sentence

CLAIMS_FILE = "claims.json"
MOST_NAMES = 400
"""Characters that names of rows may take in a summary."""

SHOWN_FIRST = ("bga", "coin")
"""Specimens of which a demo's page opens with the first that is there."""

MOST_JSON = 1 << 24
"""Bytes of a table that is read: some ten thousand rows."""

_TREATED = ("-deconvolved",)  # of a demo's clouds, the one that is shown instead of the raw one


def page_of(result: Path, mesh: Path | None, for_papers: bool, align: Alignment = "none") -> Page:
    """The page of a result.

    Parameters
    ----------
    result : Path
        A cloud (PLY), a calibration (.h5), a table (.json), or the folder of a demo.
    mesh : Path, optional
        What a cloud should lie on.
    for_papers : bool
        Whether panels are drawn as PNG too.
    align : "none", "rigid" or "similarity"
        Motion of a cloud's points before they are compared, as in `compare`.

    Raises
    ------
    InputError
        If it is none of these, or damaged.
    """
    if not result.is_dir():
        check_readable(
            result,
            missing=f"there is no {result}: give a cloud (.ply), a calibration (.h5), a table (.json) or a folder",
        )
    kind = "folder" if result.is_dir() else result.suffix.lower()
    if mesh is None and align != "none":
        raise InputError(f"--align {align} needs a mesh that the points of {result} are laid on: name it")
    if mesh is not None and kind != ".ply":
        raise InputError(f"{result} is no cloud (.ply), and only clouds are compared with a mesh: leave {mesh} out")
    if kind == ".ply":
        nominal = None if mesh is None else read_mesh(mesh)
        return cloud_page(result.name, read_cloud(result), nominal, for_papers, align)
    if kind in (".h5", ".hdf5"):
        return calibration_page(result.name, Calibration.load(result), for_papers)
    if kind == ".json":
        return table_page(result)
    if kind == "folder":
        return folder_page(result, for_papers)
    raise InputError(
        f"{result}: a report is of a cloud (.ply), a calibration (.h5), a table (.json) or a demo's folder"
    )


def cloud_page(name: str, cloud: PointCloud, mesh: Mesh | None, for_papers: bool, align: Alignment = "none") -> Page:
    """Heights, errors against a mesh, uncertainties, and the surface itself."""
    section, view = _cloud_section(name, "surface", cloud, mesh, for_papers, align)
    return Page(f"Measured points: {name}", _written(), [section], [view], surfaces_before=0)


def calibration_page(name: str, calibration: Calibration, for_papers: bool) -> Page:
    """What a calibration says about itself: first its figures, and how far it may displace heights."""
    first, *sections = calibration_sections(calibration, for_papers)
    uncertainty = sections[-1].figures[0]
    lead = Lead(first.tables[0], "", Figure(uncertainty.panels[:1], "Standard uncertainty that all points share."))
    return Page(f"Calibration: {name}", _written(), sections, lead=lead)


def calibration_sections(calibration: Calibration, for_papers: bool) -> list[Section]:
    """Facts, and the figures that a calibration's file holds."""
    identity, procedure = calibration.identity, calibration.procedure
    facts = {
        "rig": identity.name,
        "camera": identity.camera_serial,
        "projector": identity.projector_serial,
        "settings, SHA-256": identity.settings_sha256,
        "run": calibration.run,
        "fringes": f"periods {', '.join(f'{p:g}' for p in procedure.periods_px)} px, "
        f"steps {', '.join(map(str, procedure.steps))}",
        "planes": f"{procedure.planes} planes {1e3 * procedure.plane_step_mm:g} µm apart",
        **calibration.figures,
    }
    planes = calibration_figures.planes_figure(calibration, for_papers)
    figures = [
        ("Spots in all postures", calibration_figures.postures_figure(calibration, for_papers)),
        ("Reprojection", calibration_figures.reprojection_figure(calibration, for_papers)),
        ("Phase and height", calibration_figures.phase_height_figure(calibration, for_papers)),
        ("Planes of the calibration", planes),
        ("Uncertainty by the calibration", calibration_figures.uncertainty_figure(calibration, for_papers)),
    ]
    sections = [Section("Calibration", tables=[facts_table(facts, "The calibration's figures")])]
    return sections + [Section(title, figures=[figure]) for title, figure in figures if figure is not None]


def table_page(path: Path) -> Page:
    """The rows of ``claims.json`` or of ``greenough accept``."""
    document = _document(path)
    sections, summary, alarm = _table_sections(path, document)
    lead = _lead(document, None, for_papers=False)
    title = f"{sections[0].title}: {path.name}"
    return Page(title, summary, sections, alarm=alarm, surfaces_before=len(sections), lead=lead)


def folder_page(folder: Path, for_papers: bool) -> Page:
    """What a demo left: its claims, its calibration, and each part's points against the mesh that was rendered."""
    path = folder / CLAIMS_FILE
    if not path.is_file():
        raise InputError(f"the folder {folder} has no {CLAIMS_FILE}: give the folder of a demo, or a single result")
    document = _document(path)
    (*sections, made_with), summary, alarm = _table_sections(path, document)
    before = len(sections)
    views = []
    for truth in sorted(folder.glob("*-truth.ply")):
        name = truth.name.removesuffix("-truth.ply")
        clouds = [folder / f"{name}{ending}.ply" for ending in (*_TREATED, "")]
        cloud = next((path for path in clouds if path.is_file()), None)
        if cloud is not None:
            section, view = _cloud_section(cloud.stem, cloud.stem, read_cloud(cloud), read_mesh(truth), for_papers)
            sections.append(section)
            views.append(view)
    calibration = folder / "calibration.h5"
    if calibration.is_file():
        sections += calibration_sections(Calibration.load(calibration), for_papers)
    sections.append(made_with)
    lead = _lead(document, _relief(views, for_papers), for_papers)
    return Page(f"Results: {folder.resolve().name}", summary, sections, views, alarm, before, lead)


def _relief(views: Sequence[SurfaceView], for_papers: bool) -> Figure | None:
    """The specimen of a demo's folder that its page opens with."""
    found = {view.name.partition("-")[0]: view for view in views}
    view = next((found[name] for name in SHOWN_FIRST if name in found), views[0] if views else None)
    if view is None:
        return None
    name = view.name.removesuffix("-deconvolved")
    return relief_figure(name, name, view.xyz, view.origin, view.note, for_papers)


def _lead(document: Mapping[str, Any], figure: Figure | None, for_papers: bool) -> Lead | None:
    """What a page of a table opens with: of a file of an older version, which has no verdict, at most a picture."""
    lines = _verdict(document)
    if not lines:
        return None if figure is None else Lead(None, "", figure)
    if isinstance(document.get("claims"), list):
        return verdict_lead(lines, figure, for_papers)
    return acceptance_lead(lines, for_papers)


def _cloud_section(
    name: str, stem: str, cloud: PointCloud, mesh: Mesh | None, for_papers: bool, align: Alignment = "none"
) -> tuple[Section, SurfaceView]:
    tables = [facts_table({"points": len(cloud.xyz), **cloud.facts}, "What the file says of itself")]
    layers = {}
    if mesh is not None:
        surface = Surface.of(mesh)
        motion = np.eye(4) if align == "none" else fit_motion(cloud.xyz, surface, scale=align == "similarity")
        errors = vertical_errors(cloud.xyz @ motion[:3, :3].T + motion[:3, 3], surface)
        layers["error"] = 1e3 * errors
        selections = {"all points": np.ones(len(errors), dtype=bool)}
        if cloud.smooth is not None:
            selections["smooth"] = cloud.smooth
        rows = {which: error_row("vertical", which, errors[chosen]) for which, chosen in selections.items()}
        facts = {
            f"vertical error, {which}": f"bias {fixed(row.bias_um, 2)} µm, RMSE {row.rmse_um:.2f} µm, "
            f"95 % within {row.p95_um:.2f} µm, largest {row.max_um:.1f} µm, n = {text_of(row.n)}"
            for which, row in rows.items()
        }
        tables.insert(0, facts_table(facts, "Errors against the mesh"))
    note = f"Filter: {cloud.facts.get('filter', 'not stated')}; alignment: {align}."
    if cloud.smooth is not None:  # with the other layers it comes onto the same grid
        layers["smooth"] = cloud.smooth.astype(np.float32)
    view = view_of_cloud(name, cloud, layers, note)
    shown = {layer.name: layer.values for layer in view.layers}
    smooth = shown.pop("smooth", None)
    counts = None if smooth is None else smooth > 0.5
    view = SurfaceView(
        view.name, view.xyz, [layer for layer in view.layers if layer.name != "smooth"], view.note, view.origin
    )
    figures = cloud_figures(stem, view.xyz, shown, counts, view.origin, for_papers)
    figures = [Figure(figure.panels, f"{figure.caption} {note}") for figure in figures]
    return Section(name, figures=figures, tables=tables), view


def _table_sections(path: Path, document: Mapping[str, Any]) -> tuple[list[Section], str, bool]:
    environment = document.get("environment")
    tables: list[Table] = []
    if isinstance(document.get("claims"), list):
        rows = _rows(path, document["claims"])
        wrong = [row for row in rows if not is_as_expected(row)]
        judged = sum(row.get("holds") is not None for row in rows)
        title, summary = "Claims", summary_of_claims(len(rows), judged, wrong, _verdict(document))
        tables.append(claims_table(rows))
        text = CLAIMS_TEXT
    elif isinstance(document.get("rows"), list):
        rows = _rows(path, document["rows"])
        wrong = [row for row in rows if row.get("holds") is False]
        missing = document.get("missing")
        title = "Acceptance"
        summary = f"{len(rows)} rows; " + (
            f"{len(wrong)} do not hold: {', '.join(str(row.get('name')) for row in wrong)}." if wrong else "all hold."
        )
        artefact_of = {
            str(name): str(line.get("artefact"))
            for line in _verdict(document)
            for name in (line["rows"] if isinstance(line.get("rows"), list) else ())
        }
        tables.append(acceptance_table(rows, artefact_of))
        text = "Shaded rows do not keep to their limit."
        if isinstance(missing, dict) and missing:
            summary += f" {len(missing)} are missing."
            wrong = [*wrong, {}]
            tables.append(facts_table(missing, "Missing rows and why"))
    else:
        raise InputError(f"{path} holds no claims and no rows: give the file of `greenough demo` or `greenough accept`")
    facts = environment if isinstance(environment, dict) else {}
    made_with = Section("Made with", tables=[facts_table(facts, "What the figures were computed with")])
    return [Section(title, text, tables=tables), made_with], summary, bool(wrong)


CLAIMS_TEXT = (
    "“Paper” is the paper's figure. A row with a limit holds or does not; where the physics of this set-up says that "
    "it cannot hold, it is expected not to, and “predicted” is the size that an independent model expects. Rows "
    "without a limit only report. A row that behaves otherwise than expected is shaded and marked."
)


def summary_of_claims(
    rows: int, judged: int, wrong: Sequence[Mapping[str, Any]], verdict: Sequence[Mapping[str, Any]] = ()
) -> str:
    """One sentence on all rows, after one on the lines of a verdict if there are any."""
    first = f"{verdict_sentence(verdict)} " if verdict else ""
    if not wrong:
        return f"{first}{rows} rows; {judged} have a limit, all of these behave as expected."
    names = first_few([f"{row.get('claim')} ({row.get('specimen')})" for row in wrong], MOST_NAMES, "the table below")
    behave = "behaves" if len(wrong) == 1 else "behave"
    return f"{first}{rows} rows; {judged} have a limit, {len(wrong)} {behave} otherwise than expected: {names}."


def _verdict(document: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """The lines of a file's verdict; none where it has none."""
    lines = document.get("verdict")
    return [line for line in lines if isinstance(line, dict)] if isinstance(lines, list) else []


def _document(path: Path) -> dict[str, Any]:
    if path.stat().st_size > MOST_JSON:
        raise InputError(f"{path} has {path.stat().st_size} bytes, a table at most {MOST_JSON}: give a table of rows")
    with reading(path):
        content = path.read_bytes()
    try:
        document = json.loads(content.decode("utf-8"))
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path} is no JSON ({error}): give the file of `greenough demo` or `accept`") from None
    if not isinstance(document, dict):
        raise InputError(f"{path} holds no table of rows: give the file of `greenough demo` or `greenough accept`")
    return document


def _rows(path: Path, rows: list[Any]) -> list[Mapping[str, Any]]:
    if not all(isinstance(row, dict) for row in rows):
        raise InputError(f"{path} has a row that is no object: give the file of `greenough demo` or `greenough accept`")
    return rows


def _written() -> str:
    return f"Written {datetime.now(UTC):%Y-%m-%d %H:%M UTC} by greenough {version('greenough')}."
