"""The error budget: a file from which an interrupted one goes on, and changes told from chance."""

import json
from dataclasses import fields, replace
from importlib.metadata import entry_points
from pathlib import Path

import numpy as np
import pytest

from greenough.instrument.command import GROUP, run
from greenough.instrument.errors import InputError
from greenough.twin.validation import budget
from greenough.twin.validation.budget import FALSE_ALARM, MEASURED, changed, margin_of_error, steps_to_do, tables
from greenough.twin.validation.cost import METHODS, Cost
from greenough.twin.validation.effects import EFFECTS, REPEATS, cases, without

FIGURES = [field.name for field in fields(Cost)][2:]
PAGE = Path(__file__).parents[3] / "docs" / "error-budget.md"
STEPS = 16 + 30 + 1 + 5  # postures, planes, the blank side at zero, heights


def cost(case: str, method: str = "paper", **figures: float) -> Cost:
    return Cost(case, method, **(dict.fromkeys(FIGURES, 1.0) | figures))


def lines_of(monkeypatch, runs: list[str], stop_after: int | None = None) -> None:
    def measure(rig, overrides, case, run, advance):
        if stop_after is not None and len(runs) == stop_after:
            raise KeyboardInterrupt
        runs.append(case)
        advance(STEPS)
        return [cost(case, method) for method in METHODS]

    monkeypatch.setattr(budget, "measure_cost", measure)


def test_an_interrupted_budget_goes_on(monkeypatch, tmp_path):
    runs: list[str] = []
    lines_of(monkeypatch, runs, stop_after=4)
    out = tmp_path / "budget.json"
    with pytest.raises(KeyboardInterrupt):
        budget.budget("twin", [], out, lambda steps: None)
    assert [path.name for path in tmp_path.iterdir()] == ["budget.json"]
    assert steps_to_do("twin", [], out) == STEPS * (len(cases()) - 4)
    lines_of(monkeypatch, runs)
    advanced: list[float] = []
    costs = budget.budget("twin", [], out, advanced.append)
    assert sum(advanced) == STEPS * (len(cases()) - 4)
    assert runs == [case.name for case in cases()]
    assert [c.case for c in costs] == [case.name for case in cases() for _ in METHODS]
    assert len(json.loads(out.read_text())["costs"]) == len(costs)
    assert steps_to_do("twin", [], out) == 0


def test_figures_that_could_not_be_measured_are_null_and_come_back(monkeypatch, tmp_path):
    def measure(rig, overrides, case, run, advance):
        return [cost(case, method, bias_um=float("nan")) for method in METHODS]

    monkeypatch.setattr(budget, "measure_cost", measure)
    out = tmp_path / "budget.json"
    budget.budget("twin", [], out, lambda steps: None)
    written = json.loads(out.read_text(), parse_constant=pytest.fail)
    assert {line["bias_um"] for line in written["costs"]} == {None}
    again = budget.budget("twin", [], out, lambda steps: None)
    assert all(np.isnan(line.bias_um) and line.step_um == 1.0 for line in again)
    assert tables(again)["bundle, each effect off"][2]["changes"] == ""


def test_one_line_without_figures_does_not_hide_the_changes_of_others():
    base = cost("base")
    costs = dict.fromkeys(EFFECTS, base)
    first, second = list(EFFECTS)[:2]
    costs |= {first: replace(base, bias_um=3.0), second: replace(base, bias_um=float("nan"))}
    named = changed(costs, dict.fromkeys(EFFECTS, base))
    assert (named[first], named[second]) == ("bias", "")


def test_the_file_of_other_settings_is_refused(monkeypatch, tmp_path):
    lines_of(monkeypatch, [])
    out = tmp_path / "budget.json"
    budget.budget("twin", [], out, lambda steps: None)
    with pytest.raises(InputError, match="other settings"):
        budget.budget("twin", ["twin.seed=2"], out, lambda steps: None)
    out.write_text("{}")
    with pytest.raises(InputError, match="not an error budget"):
        budget.budget("twin", [], out, lambda steps: None)


def test_the_command_prints_a_table_of_each_method_with_each_effect_off_and_alone(monkeypatch, tmp_path, capsys):
    lines_of(monkeypatch, [])
    verb = ["budget", "--out", str(tmp_path / "budget.json"), "--json"]
    assert run(verb, entry_points(group=GROUP)) == 0
    printed = json.loads(capsys.readouterr().out)
    assert len(printed) == 2 * len(METHODS)
    for method in METHODS:
        alone, off = printed[f"{method}, each effect alone"], printed[f"{method}, each effect off"]
        assert {row["on"] for row in alone} >= set(EFFECTS)
        assert {row["off"] for row in off} >= set(EFFECTS)


def test_changes_are_named_where_they_exceed_what_the_other_effects_do():
    rng = np.random.default_rng(1)
    base = cost("base")
    costs = {
        name: replace(base, bias_um=1 + x) for name, x in zip(EFFECTS, rng.normal(0, 0.1, len(EFFECTS)), strict=True)
    }
    first, second, third = list(EFFECTS)[:3]
    costs[first] = replace(base, bias_um=3.0, step_um=1.02)  # no other effect changes the step
    costs[second] = replace(base, bias_um=1.05)
    costs[third] = replace(base, step_um=1.002)
    named = changed(costs, dict.fromkeys(EFFECTS, base))
    assert named[first] == "bias, step"
    assert named[second] == named[third] == ""


def test_what_does_nothing_is_called_a_change_about_as_often_as_stated():
    """2000 budgets of normal chance and three effects that do something, of sizes near and far beyond it.

    The share of false alarms among the others is known to 0.05 % from 46 000 figures. Lenth's approximation is allowed
    half as much again, or half as much.
    """
    rng = np.random.default_rng(2)
    effects = len(EFFECTS)
    alarms = 0
    for _ in range(2000):
        changes = rng.normal(0, 0.3, effects)
        changes[:3] += 1.0, 3.0, 30.0
        alarms += (np.abs(changes[3:]) > margin_of_error(changes)).sum()
    assert alarms / (2000 * (effects - 3)) == pytest.approx(FALSE_ALARM, rel=0.5)


def test_false_alarms_are_as_rare_only_if_idle_effects_change_a_figure_alike():
    """A third of the idle effects scatters ten times as much as the others: what they do is called a change."""
    rng = np.random.default_rng(3)
    scatter = np.where(np.arange(len(EFFECTS)) % 3 == 0, 1.0, 0.1)
    draws = rng.normal(0, scatter, (200, len(EFFECTS)))
    alarms = np.mean([np.abs(changes) > margin_of_error(changes) for changes in draws])
    assert alarms > 5 * FALSE_ALARM


def test_tables_hold_what_was_measured():
    costs = [cost(case.name, method, noise_um=float(k)) for k, case in enumerate(cases()) for method in METHODS]
    table = tables(costs)["paper, each effect off"]
    order = [case.name for case in cases()]
    for row in table[2:]:
        assert row["noise_um"] == order.index(without(row["off"]))
    assert table[0]["noise_um"] == 0
    assert table[1]["noise_um"] == pytest.approx(np.std(range(REPEATS), ddof=1), abs=5e-4)
    assert set(MEASURED) <= set(table[0])


def test_the_page_has_the_tables_of_the_command():
    """A line for each effect in each table, and the columns that are printed."""
    costs = [cost(case.name, method) for case in cases() for method in METHODS]
    printed = PAGE.read_text(encoding="utf-8").split("```")[3].split("\n")
    for title, rows in tables(costs).items():
        table = printed[printed.index(f"{title}:") + 1 :][: len(rows) + 1]
        assert table[0].split() == list(dict.fromkeys(name for row in rows for name in row))
        for line, row in zip(table[1:], rows, strict=True):
            assert line.strip().startswith(str(next(iter(row.values()))))
