"""The error budget: what each effect costs, once with everything else on and once with everything else off."""

import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, fields
from pathlib import Path

import numpy as np
from scipy.stats import t as student

from greenough.instrument.errors import InputError
from greenough.instrument.files import atomic_path

from ..rig import open as open_twin
from .cost import METHODS, Cost, measure_cost, steps
from .effects import ALL, EFFECTS, NONE, alone, cases, without

FIGURES = tuple(field.name for field in fields(Cost) if field.name.endswith("_um"))
MEASURED = tuple(name for name in FIGURES if "predicted" not in name)

FALSE_ALARM = 0.01
"""Largest chance that a figure which an effect leaves alone counts as changed."""

Row = dict[str, str | float]


def steps_to_do(rig_name: str, overrides: Sequence[str], out: Path) -> int:
    """How many equal steps of progress are left; raises InputError as ``budget`` does."""
    rig, _ = open_twin(rig_name, overrides)
    done = {cost.case for cost in _done(out, rig.identity.settings_sha256)}
    return steps(rig) * sum(case.name not in done for case in cases())


def budget(rig_name: str, overrides: Sequence[str], out: Path, advance: Callable[[float], None]) -> list[Cost]:
    """Run all cases, which takes a calibration and ten captures each, and write them to ``out`` as JSON.

    The file is written after every case. If it exists, of the same rig and settings, its cases are not run again.

    Parameters
    ----------
    rig_name, overrides
        As ``greenough.twin.open`` takes them.
    out : Path
    advance : callable
        Called with 1 after each of ``steps_to_do``.

    Raises
    ------
    InputError
        If the rig is not a twin, or ``out`` holds something else.
    """
    rig, _ = open_twin(rig_name, overrides)
    settings = rig.identity.settings_sha256
    costs = _done(out, settings)
    for case in cases():
        if not any(cost.case == case.name for cost in costs):
            costs += measure_cost(rig_name, [*overrides, *case.off], case.name, case.run, advance)
            with atomic_path(out) as temporary:
                temporary.write_text(json.dumps({"settings": settings, "costs": [asdict(c) for c in costs]}, indent=1))
    return costs


def _done(out: Path, settings: str) -> list[Cost]:
    if not out.exists():
        return []
    try:
        document = json.loads(out.read_text(encoding="utf-8"))
        same, costs = document["settings"] == settings, [Cost(**cost) for cost in document["costs"]]
    except (ValueError, KeyError, TypeError):
        raise InputError(f"{out} is not an error budget: name another file.") from None
    if not same:
        raise InputError(f"{out} is the budget of other settings or another rig: remove it or name another file.")
    return costs


def tables(costs: Sequence[Cost]) -> dict[str, list[Row]]:
    """The budget of each method in µm: a table of each effect alone, and one of each effect off.

    The second begins with everything on and the standard deviations of its figures over the runs; its ``changes`` are
    those of ``changed``.
    """
    result = {}
    for method in METHODS:
        of = {cost.case: cost for cost in costs if cost.calibration == method}
        runs = [cost for case, cost in of.items() if case.startswith(ALL)]
        lone = {name: alone(name) for name in EFFECTS}
        result[f"{method}, each effect alone"] = [
            {"on": on} | _rounded(of[case], FIGURES) for on, case in {NONE: NONE, **lone, ALL: ALL}.items()
        ]
        rows: list[Row] = [{"off": NONE} | _rounded(of[ALL], MEASURED)]
        rows.append({"off": "(scatter over runs)"} | {name: round(_scatter(runs, name), 3) for name in MEASURED})
        for name in EFFECTS:
            cost = of[without(name)]
            changes = ", ".join(change.removesuffix("_um") for change in changed(cost, of[ALL], runs))
            rows.append({"off": name} | _rounded(cost, MEASURED) | {"changes": changes})
        result[f"{method}, each effect off"] = rows
    return result


def changed(cost: Cost, everything: Cost, runs: Sequence[Cost]) -> list[str]:
    """Names of the measured figures that differ by more than those of two ``runs`` of the same twin do.

    By Student's t at ``FALSE_ALARM`` for each figure, from the scatter over ``runs``, as if the two were independent.
    They share what noise they both have, so that the rule errs on the safe side.
    """
    quantile = float(student.ppf(1 - FALSE_ALARM / 2, len(runs) - 1))
    return [
        name
        for name in MEASURED
        if abs(getattr(cost, name) - getattr(everything, name)) > quantile * np.sqrt(2) * _scatter(runs, name)
    ]


def _scatter(runs: Iterable[Cost], name: str) -> float:
    return float(np.std([getattr(run, name) for run in runs], ddof=1))


def _rounded(cost: Cost, names: Iterable[str]) -> Row:
    return {name: round(getattr(cost, name), 3) for name in names}
