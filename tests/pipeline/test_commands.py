import json
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest

from greenough.instrument import opening
from greenough.instrument.command import run
from greenough.instrument.contract import Procedure, RigIdentity
from greenough.pipeline import acquisition, commands
from greenough.pipeline.point_cloud import Mesh, PointCloud, read_cloud, write_cloud, write_mesh
from greenough.pipeline.reconstruct import PointMap
from small_calibration import SHAPE, small_calibration


class Source:
    """Stands for the installed entry point."""

    name, value, module = "pipeline", "greenough.pipeline.commands:app", "greenough.pipeline.commands"

    @staticmethod
    def load():
        return commands.app


def greenough(*arguments):
    return run([str(argument) for argument in arguments], [Source])


def write_plane(folder, lift_um=0.0):
    corners = np.array([[-5.0, -3, 0], [5, -3, 0], [5, 3, 0], [-5, 3, 0]])
    write_mesh(folder / "plane.ply", Mesh(corners, np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32)))
    lift = lift_um * 1e-3
    xyz = np.random.default_rng(3).uniform([-4, -2, lift], [4, 2, lift], (500, 3))
    write_cloud(folder / "cloud.ply", PointCloud(xyz, facts={"lit_and_seen": "625"}))
    return folder / "cloud.ply", folder / "plane.ply"


def test_compare_prints_rows_and_the_valid_share(tmp_path, capsys):
    assert greenough("compare", *write_plane(tmp_path, lift_um=3.0), "--json") == 0
    result = json.loads(capsys.readouterr().out)
    assert result["valid_share"] == 0.8
    assert [(row["quantity"], row["points"], row["n"]) for row in result["rows"]] == [
        ("signed_distance", "all", 500),
        ("vertical", "all", 500),
    ]
    for row in result["rows"]:
        assert row["bias_um"] == pytest.approx(3.0)


@pytest.mark.parametrize(("tolerance", "code"), [(3.1, 0), (2.9, 1)])
def test_compare_ends_with_1_beyond_the_tolerance(tmp_path, capsys, tolerance, code):
    assert greenough("compare", *write_plane(tmp_path, lift_um=3.0), "--tolerance-um", tolerance, "--json") == code
    assert json.loads(capsys.readouterr().out)["within_tolerance"] is (code == 0)


def test_a_cloud_beside_the_mesh_is_not_within_any_tolerance(tmp_path, capsys):
    _, mesh = write_plane(tmp_path)
    write_cloud(tmp_path / "far.ply", PointCloud(np.full((3, 3), 50.0)))
    assert greenough("compare", tmp_path / "far.ply", mesh, "--tolerance-um", 1e9) == 1


def test_alignment_is_applied_when_asked(tmp_path, capsys):
    assert greenough("compare", *write_plane(tmp_path, lift_um=3.0), "--align", "rigid", "--tolerance-um", 0.01) == 0


@pytest.mark.parametrize(
    "arguments",
    [
        ("compare", "missing.ply", "plane.ply"),
        ("compare", "cloud.ply", "missing.stl"),
        ("compare", "cloud.ply", "plane.ply", "--tolerance-um", "-1"),
        ("compare", "cloud.ply", "plane.ply", "--align", "affine"),
        ("compare", "cloud.ply"),
        ("measure", "twin", "--calibration", "missing.h5", "--sample", "coin", "--out", "coin.ply"),
        ("calibrate", "no-such-rig", "--out", "cal.h5"),
        ("calibrate", "twin", "--out", "cal.h5", "--method", "guess"),
    ],
)
def test_bad_input_ends_with_2_and_one_sentence(tmp_path, monkeypatch, capsys, arguments):
    monkeypatch.chdir(tmp_path)
    write_plane(tmp_path)
    before = sorted(tmp_path.iterdir())
    assert greenough(*arguments) == 2
    assert capsys.readouterr().err.strip()
    assert sorted(tmp_path.iterdir()) == before


def test_the_verbs_of_the_pipeline_are_there():
    names = {command.name or command.callback.__name__ for command in commands.app.registered_commands}
    assert names == {"calibrate", "measure", "compare", "export"}
    assert greenough("decode", "--help") == 0


class Opened:
    """What `measure` needs of a rig when the procedure itself is replaced."""

    procedure = Procedure((64.0,), (4,), 16, 30, 0.1, 0.8, (4.0, 1.0))
    camera = SimpleNamespace(exposure_us=8000.0, exposure_limits_us=(100.0, 1e6))

    def __enter__(self):
        return self

    def __exit__(self, *exc):
        return None


@pytest.fixture
def measured(tmp_path, monkeypatch):
    """Runs `measure` with the procedure replaced; returns what the procedure was asked for, and the cloud."""
    small_calibration(Opened.procedure).save(tmp_path / "cal.h5")
    asked = {}

    def open_rig(name, overrides, **options):
        asked.update(rig=name, overrides=list(overrides), **options)
        return Opened()

    def measure(rig, calibration, placement, brackets, filter_fwhm_px, deconvolve):
        asked.update(placement=placement, brackets=brackets, filter=filter_fwhm_px, deconvolve=deconvolve)
        return PointMap(np.ones((*SHAPE, 3)))

    monkeypatch.setattr(opening, "open_rig", open_rig)
    monkeypatch.setattr(acquisition, "measure", measure)

    def call(*options):
        out = tmp_path / "cloud.ply"
        code = greenough("measure", "bench", "--calibration", tmp_path / "cal.h5", "--out", out, *options)
        return code, asked, read_cloud(out) if out.exists() else None

    return call


@pytest.mark.parametrize(("options", "method"), [((), "bundle"), (("--method", "paper"), "paper")])
def test_calibrate_hands_over_the_method(tmp_path, monkeypatch, capsys, options, method):
    asked = {}

    def calibrate(rig, out, run, advance, method):
        asked.update(out=out, run=run, method=method)
        return SimpleNamespace(identity=RigIdentity("bench", "1", "2", "0" * 64), method=method, figures={"planes": 30})

    monkeypatch.setattr(opening, "open_rig", lambda name, overrides, **options: Opened())
    monkeypatch.setattr(acquisition, "calibrate", calibrate)
    assert greenough("calibrate", "bench", "--out", tmp_path / "cal.h5", *options, "--json") == 0
    assert asked == {"out": tmp_path / "cal.h5", "run": "calibrate", "method": method}
    assert json.loads(capsys.readouterr().out)["method"] == method


def test_measure_smooths_and_merges_nothing_unless_asked(measured):
    code, asked, cloud = measured("--sample", "coin")
    assert code == 0
    assert asked["brackets"] == (1.0,)
    assert asked["filter"] is None
    assert cloud.facts["filter"] == "none"
    assert cloud.facts["calibration"] == "bundle"


def test_measure_hands_over_what_was_asked_and_the_cloud_says_so(measured):
    code, asked, cloud = measured(
        *("--sample", "gear.stl", "--unit", "inch", "--pose", "1,2,0.5,0,0,90"),
        *("--bracket", "--deconvolve", "--filter-fwhm-px", "2", "--set", "a.b=1", "--run", "friday"),
    )
    assert code == 0
    assert (asked["placement"].part, asked["placement"].unit) == ("gear.stl", "inch")
    assert asked["placement"].pose_mm_deg == (1, 2, 0.5, 0, 0, 90)
    assert asked["brackets"] == (4.0, 1.0)
    assert asked["filter"] == 2.0
    assert asked["deconvolve"]
    assert cloud.facts["deconvolved"] == "yes"
    assert asked["overrides"] == ["a.b=1"]
    assert asked["run"] == cloud.facts["run"] == "friday"
    assert cloud.facts["brackets"] == "4 1"
    assert cloud.facts["filter"] == "plane under a gaussian on phasors, fwhm 2 px"


def test_a_cloud_names_only_the_exposures_that_were_taken(measured, monkeypatch):
    monkeypatch.setattr(Opened, "camera", SimpleNamespace(exposure_us=8000.0, exposure_limits_us=(100.0, 20_000.0)))
    _, _, cloud = measured("--sample", "coin", "--bracket")
    assert cloud.facts["brackets"] == "1"


def test_two_samples_are_measured_in_runs_of_their_own(measured):
    runs = {measured("--sample", sample)[1]["run"] for sample in ("coin", "bga", "parts/gear.stl")}
    assert len(runs) == 3


def test_a_pose_that_is_not_six_numbers_is_refused(measured):
    assert measured("--sample", "gear.stl", "--pose", "1,2,3")[0] == 2


@pytest.mark.slow
def test_the_pipeline_works_where_the_twin_cannot_be_imported(tmp_path):
    cloud, mesh = write_plane(tmp_path)
    program = (
        "import sys\n"
        "sys.modules['greenough.twin'] = None\n"
        "import greenough.pipeline, greenough.pipeline.commands, greenough.pipeline.acquisition\n"
        "from greenough.pipeline.compare import compare\n"
        "from greenough.pipeline.point_cloud import read_cloud, read_mesh\n"
        "print(compare(read_cloud(sys.argv[1]), read_mesh(sys.argv[2])).points)\n"
    )
    done = subprocess.run([sys.executable, "-c", program, str(cloud), str(mesh)], capture_output=True, text=True)
    assert done.stdout.strip() == "500", done.stderr
