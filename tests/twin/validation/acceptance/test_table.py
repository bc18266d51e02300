"""Claims about the whole table: what makes it fail, and how the command says so."""

import json
from dataclasses import fields
from importlib.metadata import entry_points
from types import SimpleNamespace

import pytest

from greenough.instrument.command import GROUP, run
from greenough.instrument.errors import InputError
from greenough.twin.validation.acceptance import table
from greenough.twin.validation.acceptance.rows import Row, row
from greenough.twin.validation.acceptance.table import Group, Instrument, judge

SMALL = ("twin.optics.glass=false", "camera.rows=60", "camera.cols=80", "twin.optics.camera_focal_px=1417.6875")


def group(*values: float, names: tuple[str, ...] | None = None, refuses: bool = False) -> Group:
    """Rows a, b, ... with these values against a limit of 1; the last refuses to be measured."""

    def rows(its: Instrument, advance):
        for letter, value in zip("abc", values, strict=False):
            yield row(its.as_it_is, letter, value, "um", 1, "made up", limit=1.0)
            advance(1)
        if refuses:
            raise InputError("the ball is not there")

    return Group(names or tuple("abc"[: len(values)]), len(values), rows)


@pytest.fixture
def instrument(setup):
    return Instrument(setup, setup)


def judged(instrument, monkeypatch, **groups: Group):
    monkeypatch.setattr(table, "GROUPS", groups)
    return judge(instrument, lambda steps: None)


def test_a_table_whose_rows_all_hold_is_accepted(instrument, monkeypatch):
    found = judged(instrument, monkeypatch, ball=group(0.5, -1.0))
    assert found.holds
    assert [row.name for row in found.rows] == ["a", "b"]


def test_one_row_that_does_not_hold_or_has_no_figure_refuses_it(instrument, monkeypatch):
    for value in (1.5, float("nan")):
        found = judged(instrument, monkeypatch, ball=group(0.5, value))
        assert not found.holds
        assert found.not_holding == ["b"]
        assert not found.missing


def test_a_row_that_should_be_there_and_is_not_refuses_it(instrument, monkeypatch):
    found = judged(instrument, monkeypatch, ball=group(0.5, names=("a", "z")))
    assert not found.holds
    assert list(found.missing) == ["z"]


def test_what_cannot_be_measured_is_missing_with_the_reason_and_the_others_are_measured(instrument, monkeypatch):
    groups = {"ball": group(0.5, names=("a", "y", "z"), refuses=True), "plane": group(0.1, 0.2, 0.3)}
    found = judged(instrument, monkeypatch, **groups)
    assert dict.fromkeys(("y", "z"), "ball: the ball is not there") == found.missing
    assert [row.name for row in found.rows] == ["a", "a", "b", "c"]


def test_no_two_rows_of_the_real_table_have_one_name():
    names = [name for each in table.GROUPS.values() for name in each.names]
    assert len(set(names)) == len(names)
    # What the table has to show.
    for start, least in (
        ("sphere_form_", 4), ("sphere_size_", 2), ("sphere_spacing_", 8), ("flatness_95_", 14), ("flatness_all_", 14),
        ("step_", 6), ("alpha_", 3), ("linearity_", 1), ("mapping_d", 4), ("noise_plane", 4), ("noise_coin", 4),
        ("noise_bga", 4), ("lateral_period_limit_", 4), ("bga_", 9), ("diaphragm_profile_", 6),
        ("diaphragm_stroke_", 3), ("diaphragm_volume_", 3),
    ):  # fmt: skip
        assert sum(name.startswith(start) for name in names) >= least, start


@pytest.fixture
def command(monkeypatch, tmp_path, capsys):
    """Runs the command with made-up groups and no calibration of its own: exit code, what it printed, what it wrote."""

    def ran(**groups: Group):
        monkeypatch.setattr(table, "GROUPS", groups)
        calibration = SimpleNamespace(method="bundle", check_fits=lambda identity, shape: None)
        monkeypatch.setattr(table.Calibration, "load", lambda path: calibration)
        out = tmp_path / "table.json"
        settings = [word for setting in SMALL for word in ("--set", setting)]
        arguments = ["accept", "twin", "--calibration", "any.h5", "--out", str(out), "--json", *settings]
        arguments += ["--report", str(tmp_path / "table.html")]
        code = run(arguments, entry_points(group=GROUP))
        return code, json.loads(capsys.readouterr().out), json.loads(out.read_text(encoding="utf-8"))

    return ran


def test_the_command_ends_with_0_if_every_row_holds_and_writes_what_it_prints(command):
    code, printed, written = command(ball=group(0.5, 0.2))
    assert code == 0
    assert printed["rows"] == written["rows"]
    assert set(printed["rows"][0]) == {field.name for field in fields(Row)}
    assert written["environment"]["rig"] == "twin"


def test_the_command_writes_a_page_of_the_table_where_asked(command, tmp_path):
    command(ball=group(0.5, 1.5))
    page = (tmp_path / "table.html").read_text(encoding="utf-8")
    assert page.count('<tr class="unexpected">') == 2  # the artefact's line of the verdict, and the row
    assert "2 rows; 1 do not hold" in page


@pytest.mark.parametrize(
    "groups",
    [{"ball": group(0.5, 1.5)}, {"ball": group(0.5, names=("a", "z"))}, {"ball": group(refuses=True, names=("a",))}],
)
def test_the_command_ends_with_1_if_a_row_fails_or_is_missing(command, groups):
    code, printed, written = command(**groups)
    assert code == 1
    assert printed["not_holding"] or printed["missing"]
    assert written["missing"] == printed["missing"]


def test_a_calibration_of_another_camera_is_bad_input_and_writes_nothing(monkeypatch, tmp_path):
    def refuse(identity, shape):
        raise InputError("the calibration is of another camera")

    monkeypatch.setattr(table.Calibration, "load", lambda path: SimpleNamespace(method="bundle", check_fits=refuse))
    out = tmp_path / "table.json"
    with pytest.raises(InputError, match="another camera"):
        table.accept("twin", SMALL, tmp_path / "any.h5", out, lambda steps: None)
    assert not out.exists()
