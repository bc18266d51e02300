"""The tables of an ablation: every effect in its line, changes told from chance, nothing hidden that is missing."""

import math
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

from greenough.twin.validation.cost import METHODS, Cost
from greenough.twin.validation.studies.ablation import (
    ALL,
    FALSE_ALARM,
    NONE,
    Effect,
    cases_of,
    changed,
    margin_of_error,
    tables,
    without,
)
from greenough.twin.validation.studies.runs import Outcome, Run
from greenough.twin.validation.studies.study_file import load_study
from greenough.twin.validation.studies.summary import statistics
from greenough.twin.validation.studies.summary import tables as study_tables

PAGE = Path(__file__).parents[4] / "docs" / "error-budget.md"
STUDY = load_study("ablation")
EFFECTS = STUDY.effects
BASE = {"bias_um": 1.0, "noise_um": 1.0, "noise_predicted_um": 1.0, "step_um": 1.0}


def test_an_effect_inside_another_is_added_to_it():
    effects = {"glass": Effect(off=("a=0",)), "colour": Effect(off=("b=0",), within="glass"), "c": Effect(off=("c=0",))}
    assert cases_of(effects) == {
        ALL: (),
        NONE: ("a=0", "b=0", "c=0"),
        "glass alone": ("b=0", "c=0"),
        "colour alone, in glass": ("c=0",),
        "c alone": ("a=0", "b=0"),
        "all but glass": ("a=0",),
        "all but colour": ("b=0",),
        "all but c": ("c=0",),
    }
    assert cases_of({}) == {}


def test_each_effect_is_compared_with_the_twin_without_it():
    effects = {"glass": Effect(off=("a=0",)), "colour": Effect(off=("b=0",), within="glass")}
    figures = {ALL: 7.0, NONE: 0.0, "glass alone": 5.0, "colour alone, in glass": 5.0}
    means = {case: BASE | {"step_um": step} for case, step in figures.items()}
    means |= {without("glass"): BASE | {"step_um": 7.0}, without("colour"): BASE | {"step_um": 7.0}}
    single, off = tables(effects, means, BASE)
    assert [row["on"] for row in single] == [NONE, "glass", "colour", ALL]
    assert [row["step_um"] for row in single] == [0, 5, 5, 7]
    assert single[2]["changes"] == ""
    assert [row["off"] for row in off] == [NONE, "(scatter over runs)", "glass", "colour"]
    assert all("noise_predicted_um" in row for row in single)
    assert not any("noise_predicted_um" in row for row in off)


def test_one_line_without_figures_does_not_hide_the_changes_of_others():
    costs = dict.fromkeys(EFFECTS, BASE)
    first, second = list(EFFECTS)[:2]
    costs |= {first: BASE | {"bias_um": 3.0}, second: BASE | {"bias_um": math.nan}}
    named = changed(costs, dict.fromkeys(EFFECTS, BASE))
    assert (named[first], named[second]) == ("bias", "")


def test_changes_are_named_where_they_exceed_what_the_other_effects_do():
    rng = np.random.default_rng(1)
    costs = {name: BASE | {"bias_um": 1 + x} for name, x in zip(EFFECTS, rng.normal(0, 0.1, len(EFFECTS)), strict=True)}
    first, second, third = list(EFFECTS)[:3]
    costs[first] = BASE | {"bias_um": 3.0, "step_um": 1.02}  # no other effect changes the step
    costs[second] = BASE | {"bias_um": 1.05}
    costs[third] = BASE | {"step_um": 1.002}
    named = changed(costs, dict.fromkeys(EFFECTS, BASE))
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


def finished(values: dict[tuple[str, int], float]) -> list[tuple[Run, Outcome]]:
    """A result of every run of the study ablation, of one instrument; ``values`` of (case, repeat), else 1."""
    result = []
    for case in STUDY.all_cases:
        for repeat in range(1, STUDY.repeats.get(case, 1) + 1):
            run = Run(case, 1, repeat, "cost", "twin", (), "", "")
            noise = values.get((case, repeat), 1.0)
            figures = [{"calibration": method} | BASE | {"noise_um": noise} for method in METHODS]
            result.append((run, Outcome(figures, None, 1.0, {})))
    return result


def test_tables_hold_what_was_measured_and_the_scatter_is_that_of_the_repeats():
    cases = list(STUDY.all_cases)
    values = {(case, 1): float(k) for k, case in enumerate(cases)} | {(ALL, 2): 1.0, (ALL, 3): 2.0, (ALL, 4): 3.0}
    runs = finished(values)
    table = study_tables(STUDY, runs, statistics(runs))["paper, each effect off"]
    for row in table[2:]:
        assert row["noise_um"] == cases.index(without(row["off"]))
    assert table[0]["noise_um"] == 0
    assert table[1]["noise_um"] == pytest.approx(np.std(range(4), ddof=1), abs=5e-4)


def test_a_case_that_failed_has_a_line_without_figures():
    runs = finished({})
    first = next(iter(EFFECTS))
    failed = [(run, Outcome([], "no board.", 1.0, {}) if run.case == without(first) else out) for run, out in runs]
    table = study_tables(STUDY, failed, statistics(failed))["paper, each effect off"]
    row = next(row for row in table if row["off"] == first)
    assert math.isnan(row["noise_um"])
    assert row["changes"] == ""


def test_the_page_has_the_tables_of_the_command():
    """A line for each effect in each table, and the columns that are printed."""
    figures = {field.name: 1.0 for field in fields(Cost) if field.name != "calibration"}
    runs = [(run, Outcome([{"calibration": method} | figures for method in METHODS], None, 1.0, {}))
            for run, _ in finished({})]  # fmt: skip
    printed = PAGE.read_text(encoding="utf-8").split("```")[3].split("\n")
    for title, rows in study_tables(STUDY, runs, statistics(runs)).items():
        table = printed[printed.index(f"{title}:") + 1 :][: len(rows) + 1]
        assert table[0].split() == list(dict.fromkeys(name for row in rows for name in row))
        for line, row in zip(table[1:], rows, strict=True):
            assert line.strip().startswith(str(next(iter(row.values()))))
