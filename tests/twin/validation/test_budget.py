"""The error budget: a file from which an interrupted one goes on, and changes told from chance."""

import json
from dataclasses import fields, replace
from importlib.metadata import entry_points

import numpy as np
import pytest

from greenough.instrument.command import GROUP, run
from greenough.instrument.errors import InputError
from greenough.twin.validation import budget
from greenough.twin.validation.budget import FALSE_ALARM, MEASURED, changed, steps_to_do, tables
from greenough.twin.validation.cost import METHODS, Cost
from greenough.twin.validation.effects import ALL, EFFECTS, REPEATS, cases, without

FIGURES = [field.name for field in fields(Cost)][2:]
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


def test_changes_are_named_where_they_exceed_what_chance_does():
    rng = np.random.default_rng(1)
    runs = [cost(f"{ALL} {k}", bias_um=x) for k, x in enumerate(rng.normal(0, 0.1, REPEATS))]
    quiet = [replace(each, noise_um=1.0) for each in runs]  # whose noise does not scatter at all
    assert changed(replace(quiet[0], bias_um=quiet[0].bias_um + 5), quiet[0], quiet) == ["bias_um"]
    assert changed(replace(quiet[0], noise_um=0.999), quiet[0], quiet) == ["noise_um"]
    assert changed(quiet[0], quiet[0], quiet) == []


def test_what_does_nothing_is_hardly_called_a_change():
    """Of 4000 independent figures at most the share ``FALSE_ALARM``, and four standard deviations of its count."""
    rng = np.random.default_rng(2)
    trials, alarms = 4000, 0
    for values in rng.normal(0, 1, (trials, REPEATS + 1)):
        runs = [cost(ALL, step_um=value) for value in values[1:]]
        alarms += len(changed(cost("x", step_um=values[0]), runs[0], runs))
    assert 0 < alarms / trials < FALSE_ALARM + 4 * np.sqrt(FALSE_ALARM / trials)


def test_tables_hold_what_was_measured():
    costs = [cost(case.name, method, noise_um=float(k)) for k, case in enumerate(cases()) for method in METHODS]
    table = tables(costs)["paper, each effect off"]
    order = [case.name for case in cases()]
    for row in table[2:]:
        assert row["noise_um"] == order.index(without(row["off"]))
    assert table[0]["noise_um"] == 0
    assert table[1]["noise_um"] == pytest.approx(np.std(range(REPEATS), ddof=1), abs=5e-4)
    assert set(MEASURED) <= set(table[0])
