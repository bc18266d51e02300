"""Claims about ``greenough report``: each kind of result has a page with its figures, and bad files one sentence."""

import json
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from greenough.instrument import opening
from greenough.instrument.command import run
from greenough.pipeline import acquisition, commands
from greenough.pipeline.calibration import Residuals
from greenough.pipeline.point_cloud import Mesh, PointCloud, write_cloud, write_mesh
from greenough.pipeline.reconstruct import PointMap
from greenough.pipeline.report.page import write_page
from greenough.pipeline.report.results import page_of
from greenough.pipeline.report.tables import text_of


class Source:
    """Stands for the installed entry point."""

    name, value, module = "pipeline", "greenough.pipeline.commands:app", "greenough.pipeline.commands"

    @staticmethod
    def load():
        return commands.app


def report(*arguments) -> int:
    return run(["report", *map(str, arguments)], [Source])


def write_part(folder: Path, name: str = "part", lift_um: float = 3.0) -> tuple[Path, Path]:
    """Points of a plane, lifted above its mesh, with pixels, smooth points and uncertainties."""
    v, u = np.mgrid[:40, :60]
    xyz = np.stack([0.1 * u - 3, 2 - 0.1 * v, np.full(u.shape, 1e-3 * lift_um)], axis=-1).reshape(-1, 3)
    pixels = np.stack([v.ravel(), u.ravel()], axis=-1)
    sigma = np.full(xyz.shape, 2e-3, np.float32)
    facts = {"filter": "none", "specimen": name}
    light = pixels[:, 1].astype(np.float32)
    cloud = PointCloud(xyz, pixels, pixels[:, 0] > 5, sigma, sigma / 5, intensity=light, facts=facts)
    write_cloud(folder / f"{name}.ply", cloud)
    corners = np.array([[-9.0, -9, 0], [9, -9, 0], [9, 9, 0], [-9, 9, 0]])
    write_mesh(folder / f"{name}-truth.ply", Mesh(corners, np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32)))
    return folder / f"{name}.ply", folder / f"{name}-truth.ply"


def write_claims(folder: Path, **changes) -> Path:
    row = {
        "claim": "depth", "specimen": "plane", "paper": 4.0, "measured": 3.0, "unit": "um", "n": 10, "filter": "none",
        "alignment": "none", "calibration": "bundle", "seed": 1, "limit": 4.0, "holds": True, "expected_to_hold": True,
        "criterion": "95 %", "predicted": None, "predicted_sd": None,
    }  # fmt: skip
    path = folder / "claims.json"
    path.write_text(json.dumps({"claims": [row | changes], "environment": {"python": "3.11"}}))
    return path


def panels(page) -> set[str]:
    return {panel.name for section in page.sections for figure in section.figures for panel in figure.panels}


def words(page) -> str:
    tables = [table for s in page.sections for table in s.tables]
    tables += [page.lead.table] if page.lead is not None and page.lead.table is not None else []
    cells = [cell for table in tables for row in table.rows for cell in row.cells]
    return " ".join(f"{cell.text} {cell.small}" for cell in cells)


def test_a_cloud_has_heights_uncertainties_and_against_a_mesh_its_errors(tmp_path, capsys):
    cloud, mesh = write_part(tmp_path)
    out, figures = tmp_path / "page.html", tmp_path / "figures"
    assert report(cloud, mesh, "--out", out, "--png", figures, "--json") == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed["surfaces"] == 1
    assert printed["bytes"] == out.stat().st_size
    parts = ("picture", "height", "error", "error-histogram", "sigma-0", "sigma-1")
    names = {f"surface-{part}" for part in parts}
    assert {path.stem for path in figures.iterdir()} == names
    page = page_of(cloud, mesh, for_papers=False)
    told = " ".join(words(page).split())
    assert "smooth bias 3.00 µm, RMSE 3.00 µm, 95 % within 3.00 µm, largest 3.0 µm, n = 2 040" in told
    shown = [layer.name for layer in page.surfaces[0].layers]
    assert shown == ["error", "σ z by noise", "σ z by calibration", "brightness"]
    assert panels(page_of(cloud, None, for_papers=False)) == names - {"surface-error", "surface-error-histogram"}


def test_a_cloud_is_laid_on_its_mesh_where_asked(tmp_path):
    cloud, mesh = write_part(tmp_path, lift_um=50.0)
    page = page_of(cloud, mesh, for_papers=False, align="rigid")
    assert "smooth bias 0.00 µm, RMSE 0.00 µm" in " ".join(words(page).split()).replace("−", "").replace("-", "")
    assert "alignment: rigid." in page.surfaces[0].note


def test_an_alignment_without_a_mesh_is_refused(tmp_path, capsys):
    assert report(write_part(tmp_path)[0], "--align", "rigid", "--out", tmp_path / "page.html") == 2
    assert "needs a mesh" in " ".join(capsys.readouterr().err.split())


def test_a_calibration_has_the_papers_figures_8_to_10_and_its_planes_and_uncertainty(tmp_path, calibration):
    calibration().save(tmp_path / "cal.h5")
    page = page_of(tmp_path / "cal.h5", None, for_papers=False)
    assert panels(page) == {
        "postures", "coverage", "spots-per-posture", "reprojection", "reprojection-histogram",
        "reprojection-by-posture", "phase-height", "phase-height-bend", "planes-pixels", "planes", "planes-histogram",
        "calibration-uncertainty", "calibration-uncertainty-z",
    }  # fmt: skip
    assert "bench" in words(page)
    assert [panel.name for panel in page.lead.figure.panels] == ["calibration-uncertainty"]
    svg = {panel.name: panel.svg for s in page.sections for f in s.figures for panel in f.panels}
    assert ">139 centres in 4 postures<" in svg["spots-per-posture"]


def test_a_calibration_without_planes_leaves_their_figure_out(tmp_path, calibration):
    whole = calibration().residuals
    residuals = Residuals(whole.centres_px, whole.spots_px, whole.spot_phases_rad, whole.planes_um[:0], whole.pixels_um)
    calibration(method="stage-free", residuals=residuals).save(tmp_path / "cal.h5")
    assert "planes" not in panels(page_of(tmp_path / "cal.h5", None, for_papers=False))


def test_claims_say_whether_all_behave_as_expected(tmp_path):
    good = page_of(write_claims(tmp_path), None, for_papers=False)
    assert (good.alarm, good.summary) == (False, "1 rows; 1 have a limit, all of these behave as expected.")
    bad = page_of(write_claims(tmp_path, holds=False), None, for_papers=False)
    assert bad.alarm
    assert "1 behaves otherwise than expected: depth (plane)." in bad.summary
    assert [row.marked for row in bad.sections[0].tables[0].rows] == [True]


def test_acceptance_says_what_does_not_hold_and_what_is_missing(tmp_path):
    rows = [
        {"name": "sphere_form", "value": 2.0, "unit": "um", "holds": True, "criterion": "probing error"},
        {"name": "step", "value": None, "unit": "1", "holds": False, "criterion": "height"},
    ]
    path = tmp_path / "acceptance.json"
    path.write_text(json.dumps({"rows": rows, "missing": {"chirp": "no light"}, "environment": {}}))
    page = page_of(path, None, for_papers=False)
    assert page.alarm
    assert page.summary == "2 rows; 1 do not hold: step. 1 are missing."
    assert "chirp no light" in " ".join(words(page).split())
    assert [row.marked for row in page.sections[0].tables[0].rows] == [False, True]


def test_a_demos_folder_has_claims_surfaces_and_calibration(tmp_path, calibration):
    write_claims(tmp_path)
    write_part(tmp_path, "coin")
    write_part(tmp_path, "bga")
    write_part(tmp_path, "coin-deconvolved")
    (tmp_path / "coin-deconvolved-truth.ply").unlink()
    calibration().save(tmp_path / "calibration.h5")
    page = page_of(tmp_path, None, for_papers=False)
    assert [view.name for view in page.surfaces] == ["bga", "coin-deconvolved"]
    assert {"postures", "bga-error", "coin-deconvolved-error"} <= panels(page)
    assert [page.sections[0].title, page.sections[-1].title] == ["Claims", "Made with"]


LINE = {
    "claim": "depth error 95 %", "row": "depth", "specimen": "plane", "calibration": "bundle", "filter": "none",
    "unit": "um", "paper": 4.0, "measured": 2.345, "uncertainty": 0.04, "truth": None, "limit": 4.0, "bound": "at most",
    "predicted": 2.3, "verdict": "holds", "unexpected": False, "digits": 3,
}  # fmt: skip


def with_verdict(path: Path, *lines: object) -> Path:
    path.write_text(json.dumps({"verdict": lines} | json.loads(path.read_text())))
    return path


def lead_words(page) -> list[list[str]]:
    return [[cell.text for cell in row.cells] for row in page.lead.table.rows]


def test_a_table_with_a_verdict_opens_with_it_and_with_a_picture(tmp_path):
    path = with_verdict(write_claims(tmp_path), LINE, LINE | {"verdict": "fails", "unexpected": True})
    page = page_of(path, None, for_papers=False)
    assert lead_words(page) == [
        ["depth error 95 %", "4", "2.35 ± 0.04", "≤ 4 µm", "holds"],
        ["depth error 95 %", "4", "2.35 ± 0.04", "≤ 4 µm", "fails"],
    ]
    assert [row.marked for row in page.lead.table.rows] == [False, True]
    assert page.summary.startswith("Paper's claims in 2 lines: 1 hold, 1 fail. 1 rows;")
    assert [panel.name for panel in page.lead.figure.panels] == ["verdict-limits"]


def test_a_demos_folder_opens_with_its_verdict_and_the_relief_of_a_specimen(tmp_path):
    with_verdict(write_claims(tmp_path), LINE)
    write_part(tmp_path, "coin")
    page = page_of(tmp_path, None, for_papers=False)
    assert lead_words(page)[0][0] == "depth error 95 %"
    (panel,) = page.lead.figure.panels
    assert panel.name == "coin-relief"
    assert "1 mm" in panel.svg
    assert "z (mm)" in panel.svg


def test_files_of_older_versions_have_no_verdict_and_a_page_all_the_same(tmp_path):
    assert page_of(write_claims(tmp_path), None, for_papers=False).lead is None
    write_part(tmp_path, "coin")
    page = page_of(tmp_path, None, for_papers=False)
    assert page.lead.table is None
    assert [panel.name for panel in page.lead.figure.panels] == ["coin-relief"]


@pytest.mark.parametrize(
    "lines", [["words"], [{}], [{name: "words" for name in LINE}], [{name: [1e999] for name in LINE}], [None, 3]]
)
def test_a_verdict_of_anything_has_a_page(tmp_path, lines):
    path = with_verdict(write_claims(tmp_path), *lines)
    write_page(tmp_path / "page.html", page_of(path, None, for_papers=False))


@pytest.mark.parametrize("value", [1e-9, -1e9, 0.0, 1e300, 1e-300])
@pytest.mark.parametrize("bound", ["at most", "at least", "within"])
def test_a_verdict_of_extreme_figures_has_a_picture(tmp_path, value, bound):
    line = LINE | {"measured": value, "limit": 1e-9, "bound": bound, "uncertainty": abs(value)}
    write_page(tmp_path / "page.html", page_of(with_verdict(write_claims(tmp_path), line), None, for_papers=False))


def test_rows_are_folded_by_specimen_and_named_in_words(tmp_path):
    path = write_claims(tmp_path)
    document = json.loads(path.read_text())
    (row,) = document["claims"]
    rows = [row | {"claim": name, "specimen": s} for name in ("p95_filtered", "unheard_of") for s in ("coin", "plane")]
    rows[-1]["holds"] = False
    path.write_text(json.dumps(document | {"claims": rows}))
    (table,) = page_of(path, None, for_papers=False).sections[0].tables
    assert table.folded == "All 4 rows, by specimen"
    assert table.groups == {
        0: "coin: 2 rows, 2 with a limit, all as expected",
        2: "plane: 2 rows, 2 with a limit, 1 otherwise than expected",
    }
    names = [(row.cells[0].text, row.cells[0].small) for row in table.rows]
    assert names == 2 * [("95 % of the errors, filtered", "p95_filtered"), ("unheard of", "unheard_of")]


def test_numbers_are_written_with_true_minus_thin_thousands_and_five_digits():
    values = [-1234567, 3.14159265, float("nan"), None, True, (1.0, -2.0), {"a": {"b": {"c": {"d": 1}}}}]
    expected = ["−1\u202f234\u202f567", "3.1416", "–", "–", "yes", "1, −2", "a b c …"]
    assert [text_of(value) for value in values] == expected


BAD = {
    "missing.ply": None,
    "folder-without-claims": None,
    "notes.txt": b"text",
    "truncated.ply": b"ply\nformat binary_little_endian 1.0\nelement vertex 5\nproperty float x\nproperty float y\n"
    b"property float z\nend_header\n1234",
    "claims-20-GB.ply": b"ply\nformat binary_little_endian 1.0\nelement vertex 2000000000\nproperty double x\n"
    b"property double y\nproperty double z\nend_header\n" + bytes(240),
    "wrong.h5": b"no HDF5",
    "empty.json": b"",
    "list.json": b"[1, 2]",
    "deep.json": b"[" * 100_000,
    "binary.json": bytes(range(256)),
    "no-rows.json": b'{"claims": 3}',
    "rows-of-numbers.json": b'{"claims": [1, 2]}',
    "long-number.json": b'{"claims": [{"n": ' + b"9" * 5000 + b"}]}",
}


@pytest.mark.parametrize("name", BAD)
def test_bad_files_are_one_sentence_and_leave_no_page(tmp_path, capsys, name):
    path = tmp_path / name
    if name == "folder-without-claims":
        path.mkdir()
    elif BAD[name] is not None:
        path.write_bytes(BAD[name])
    assert report(path, "--out", tmp_path / "page.html") == 2
    message = capsys.readouterr().err.strip()
    assert name in message
    assert len(message.splitlines()) <= 4, message  # wrapped
    assert not (tmp_path / "page.html").exists()


def test_a_table_of_too_many_bytes_is_refused_before_it_is_read(tmp_path, capsys):
    path = tmp_path / "big.json"
    with open(path, "wb") as file:
        file.truncate(1 << 30)
    assert report(path, "--out", tmp_path / "page.html") == 2
    assert "a table at most" in capsys.readouterr().err


def test_only_clouds_are_compared_with_a_mesh(tmp_path, capsys):
    _, mesh = write_part(tmp_path)
    assert report(write_claims(tmp_path), mesh, "--out", tmp_path / "page.html") == 2
    assert "only clouds are compared with a mesh" in " ".join(capsys.readouterr().err.split())


def test_calibrate_and_measure_write_their_page_where_asked(tmp_path, calibration, monkeypatch, capsys):
    made = calibration()
    rig = SimpleNamespace(procedure=made.procedure)
    monkeypatch.setattr(opening, "open_rig", lambda *arguments, **options: nullcontext(rig))
    monkeypatch.setattr(acquisition, "calibrate", lambda *arguments: made)
    words = ["calibrate", "bench", "--out", tmp_path / "cal.h5", "--report", tmp_path / "cal.html"]
    assert run([str(word) for word in words], [Source]) == 0
    assert "Calibration: cal.h5" in (tmp_path / "cal.html").read_text(encoding="utf-8")

    made.save(tmp_path / "cal.h5")
    xyz = np.stack([*np.mgrid[:6, :8].astype(float), np.zeros((6, 8))], axis=-1)
    monkeypatch.setattr(acquisition, "measure", lambda *arguments: PointMap(xyz))
    words = ["measure", "bench", "--calibration", tmp_path / "cal.h5", "--sample", "coin"]
    words += ["--out", tmp_path / "coin.ply", "--report", tmp_path / "coin.html"]
    assert run([str(word) for word in words], [Source]) == 0
    assert 'class="surface" data-name="coin.ply"' in (tmp_path / "coin.html").read_text(encoding="utf-8")
