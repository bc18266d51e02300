"""Claims about the whole table: what makes it fail, and how the command says so."""

import json
from dataclasses import fields
from importlib.metadata import entry_points
from types import SimpleNamespace
from typing import get_args

import numpy as np
import pytest

from greenough.instrument.command import GROUP, run
from greenough.instrument.errors import InputError
from greenough.twin.validation import commands
from greenough.twin.validation.benchmarks import (
    calibrating,
    capturing,
    demonstration,
    rendering,
    required,
    startup,
    study,
    table,
)
from greenough.twin.validation.benchmarks.first_kernels import FirstUse
from greenough.twin.validation.benchmarks.required import REQUIRED
from greenough.twin.validation.benchmarks.rows import Row, limited
from greenough.twin.validation.benchmarks.table import Measurement, bench

SMALL = ("twin.optics.glass=false", "camera.rows=60", "camera.cols=80", "twin.optics.camera_focal_px=1417.6875")


def yields(*names: str, value: float = 1.0, refuses: bool = False):
    """Stands for a section's module: rows of these names with a limit of 1; then it refuses to go on."""

    def rows(rig_name, overrides):
        for name in names:
            yield limited(name, value, "s", None, None, 1.0)
        if refuses:
            raise InputError("the clock has stopped")

    return SimpleNamespace(rows=rows)


@pytest.fixture
def sections(monkeypatch: pytest.MonkeyPatch):
    """Puts made-up modules and required rows in the place of the real ones."""

    def put(wanted: dict[str, tuple[str, ...]], modules: dict[str, SimpleNamespace], peers=()) -> None:
        measured = {name: Measurement(name, peers=peers) for name in wanted}
        monkeypatch.setattr(table, "MEASUREMENTS", measured)
        monkeypatch.setattr(table, "import_module", lambda name, package: modules[name.removeprefix(".")])
        for module in (table, commands):
            monkeypatch.setattr(module, "REQUIRED", wanted)

    return put


def benched(sections=("startup",), advance=lambda amount: None):
    return bench("twin", SMALL, sections, advance)


def test_a_table_with_all_rows_that_all_hold_holds(sections) -> None:
    sections({"startup": ("a", "b")}, {"startup": yields("a", "b", "more")})
    found = benched()
    assert found.holds
    assert [row.name for row in found.rows] == ["a", "b", "more"]


def test_one_row_that_falls_short_fails_it(sections) -> None:
    for value in (1.1, float("nan")):
        sections({"startup": ("a",)}, {"startup": yields("a", value=value)})
        found = benched()
        assert not found.holds
        assert found.not_holding == ["a"]


def test_a_row_that_a_module_drops_is_found_out(sections) -> None:
    sections({"startup": ("a", "b")}, {"startup": yields("a")})
    found = benched()
    assert not found.holds
    assert found.missing == {"b": "startup yielded no such row"}


def test_a_section_that_refuses_keeps_what_it_has_and_the_others_are_run(sections) -> None:
    modules = {"startup": yields("a", refuses=True), "study": yields("c")}
    sections({"startup": ("a", "b"), "study": ("c",)}, modules)
    done = []
    found = benched(("startup", "study"), done.append)
    assert found.missing == {"b": "the clock has stopped"}
    assert [row.name for row in found.rows] == ["a", "c"]
    assert done == [1, 1]


def test_a_peer_that_is_not_installed_is_named_with_how_to_install_it(sections, monkeypatch) -> None:
    monkeypatch.setattr(table, "INSTALL", {"no_such_peer": "pip install 'greenough[bench]'"})
    sections({"startup": ("a",)}, {"startup": yields()}, ("json", "no_such_peer"))
    assert benched().missing == {"a": "no_such_peer is not installed: pip install 'greenough[bench]'"}


def test_rows_of_sections_that_were_not_asked_for_are_not_missed(sections) -> None:
    sections({"startup": ("a",), "study": ("c",)}, {"study": yields("c")})
    assert benched(("study",)).holds


def test_a_wrong_setting_is_refused_before_anything_is_timed(sections) -> None:
    sections({"startup": ("a",)}, {"startup": yields("a")})
    with pytest.raises(InputError, match=r"camera\.rows"):
        bench("twin", ["camera.rows=0"], ("startup",), lambda amount: None)


def test_every_section_has_a_measurement_and_required_rows_of_different_names() -> None:
    assert list(REQUIRED) == list(get_args(required.Section)) == list(table.MEASUREMENTS)
    names = [name for rows in REQUIRED.values() for name in rows]
    assert len(set(names)) == len(names)
    assert all(REQUIRED.values())
    assert {peer for measurement in table.MEASUREMENTS.values() for peer in measurement.peers} <= set(table.INSTALL)


@pytest.fixture
def command(sections, capsys):
    """Runs the command with a made-up section: exit code, and what it printed."""

    def ran(wanted: tuple[str, ...], module: SimpleNamespace):
        sections({"startup": wanted}, {"startup": module})
        code = run(["bench", "--json", *(f"--set={setting}" for setting in SMALL)], entry_points(group=GROUP))
        return code, json.loads(capsys.readouterr().out)

    return ran


def test_the_command_ends_with_0_if_every_row_is_there_and_holds(command) -> None:
    code, printed = command(("a",), yields("a"))
    assert code == 0
    assert printed["rows"] == [
        {"name": "a", "value": 1.0, "unit": "s", "peer": None, "ratio": None, "limit": 1.0, "holds": True}
    ]
    assert set(printed["rows"][0]) == {field.name for field in fields(Row)}
    environment = printed["environment"]
    assert environment["threads"] >= 1
    assert {"greenough", "mitsuba", "drjit", "numpy", "fringes"} <= set(environment["packages"])


@pytest.mark.parametrize(
    ("wanted", "module"),
    [(("a",), yields("a", value=2.0)), (("a", "b"), yields("a")), (("a",), yields(refuses=True))],
)
def test_the_command_ends_with_1_if_a_row_is_missing_or_falls_short(command, wanted, module) -> None:
    code, printed = command(wanted, module)
    assert code == 1
    assert printed["not_holding"] or printed["missing"]


def test_the_start_up_has_all_its_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    uses = FirstUse(2.0, 0.5, 1.0, 3, 0, 0), FirstUse(1.0, 0.5, 0.0, 0, 3, 0)
    monkeypatch.setattr(startup, "first_uses", lambda *step: uses)
    monkeypatch.setattr(startup, "REPEATS", 1)
    found = startup.rows("twin", SMALL)
    assert tuple(row.name for row in found) == REQUIRED["startup"]
    assert [row.limit for row in found if row.limit is not None] == [startup.HELP_LIMIT_S, 0, 0, 0, 0]


@pytest.mark.slow
def test_captures_have_all_their_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(capturing, "REPEATS", 1)
    # Spots on coarse pixels must be large to be found.
    coarse = ["camera.rows=240", "camera.cols=320", "twin.optics.camera_focal_px=5670.75", "twin.optics.glass=false"]
    large = ["board.small_diameter_mm=0.3", "board.big_diameter_mm=0.5", "twin.render.nodes_edges=16"]
    assert tuple(row.name for row in capturing.rows("twin", [*coarse, *large])) == REQUIRED["capturing"]


def test_renderings_have_all_their_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    """With made-up pictures and times."""

    def picture(*given: int) -> np.ndarray:
        rng = np.random.default_rng(sum(given))
        return np.cos(2 * np.pi * np.arange(12) / 12) + rng.normal(0, 0.01, (4, 5, 12))

    both = SimpleNamespace(
        ours=picture,
        ours_equal=picture,
        theirs=picture,
        reference=picture,
        has_fringes=lambda stack: np.ones(stack.shape[:2], bool),
        own=None,
        frames=24,
    )
    monkeypatch.setattr(rendering, "both_renderers", lambda *rig: both)
    monkeypatch.setattr(rendering, "rendering", lambda *scene: None)
    monkeypatch.setattr(rendering, "interleaved", lambda works, repeats: dict.fromkeys(works, 1.0))
    found = {row.name: row.limit for row in rendering.rows("twin", SMALL)}
    assert set(found) == set(REQUIRED["rendering"])
    assert sorted(limit for limit in found.values() if limit is not None) == [1 / 50, 1 / 15, 4, 4]


def test_whole_calibrations_and_the_demo_are_judged_by_their_time(monkeypatch: pytest.MonkeyPatch) -> None:
    steps = []
    monkeypatch.setattr(calibrating, "calibrate", lambda rig, out, run, advance: steps.append(advance(1)))
    monkeypatch.setattr(demonstration, "demonstrate", lambda rig, overrides, folder, advance: steps.append(folder))
    whole, *shares = calibrating.whole_calibration_rows("twin", SMALL)
    (demo,) = demonstration.rows("twin", SMALL)
    assert len(steps) == 2
    assert tuple(row.name for row in (whole, *shares)) == REQUIRED["calibration"]
    assert (demo.name,) == REQUIRED["demo"]
    assert (whole.limit, demo.limit) == (100, 240)


def test_a_study_is_compared_with_itself_on_one_worker(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(study, "_seconds", lambda runs, workers: 10.0 / workers)
    (row,) = study.rows("twin", [])
    assert (row.name,) == REQUIRED["study"]
    assert (row.ratio, row.holds) == (0.5, True)
