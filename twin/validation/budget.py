"""The error budget: what each effect costs, once with everything else on and once with everything else off."""

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

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
"""Chance, about, that a figure which an effect leaves alone counts as changed, where all such changes are alike.

The bundle's are not: one switch leaves its frames nearly as they were, another draws all of them anew. There the names
are no evidence, and the scatter over runs is what to compare with.
"""

NEGLIGIBLE_UM = 0.01
"""Changes below it are not named."""

Row = dict[str, str | float]


def steps_to_do(rig_name: str, overrides: Sequence[str], out: Path) -> int:
    """How many equal steps of progress are left; raises InputError as ``budget`` does."""
    rig, _ = open_twin(rig_name, overrides)
    done = {cost.case for cost in _done(out, rig.identity.settings_sha256)}
    return steps(rig) * sum(case.name not in done for case in cases())


def budget(rig_name: str, overrides: Sequence[str], out: Path, advance: Callable[[float], None]) -> list[Cost]:
    """Run all cases, which takes a calibration and ten captures each, and write them to ``out`` as JSON.

    The file is written after every case, NaN as null. If it exists, of the same rig and settings, its cases are not run
    again.

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
                document = {"settings": settings, "costs": [_as_json(cost) for cost in costs]}
                temporary.write_text(json.dumps(document, indent=1, allow_nan=False))
    return costs


def _as_json(cost: Cost) -> dict[str, Any]:
    values = asdict(cost).items()
    return {name: None if isinstance(value, float) and np.isnan(value) else value for name, value in values}


def _from_json(cost: Mapping[str, Any]) -> Cost:
    values: dict[str, Any] = {name: float("nan") if value is None else value for name, value in cost.items()}
    return Cost(**values)


def _done(out: Path, settings: str) -> list[Cost]:
    if not out.exists():
        return []
    try:
        document = json.loads(out.read_text(encoding="utf-8"))
        same, costs = document["settings"] == settings, [_from_json(cost) for cost in document["costs"]]
    except (ValueError, KeyError, TypeError, AttributeError):
        raise InputError(f"{out} is not an error budget: name another file.") from None
    if not same:
        raise InputError(f"{out} is the budget of other settings or another rig: remove it or name another file.")
    return costs


def tables(costs: Sequence[Cost]) -> dict[str, list[Row]]:
    """The budget of each method in µm: a table of each effect alone, and one of each effect off.

    ``changes`` names the figures that an effect changes, see ``changed``: against the twin without it in the first
    table, against the twin with everything in the second. That begins with everything on and the standard deviations
    of its figures over the runs.
    """
    result = {}
    for method in METHODS:
        of = {cost.case: cost for cost in costs if cost.calibration == method}
        bases = {name: of[alone(effect.within) if effect.within else NONE] for name, effect in EFFECTS.items()}
        single, off = {name: of[alone(name)] for name in EFFECTS}, {name: of[without(name)] for name in EFFECTS}
        added, removed = changed(single, bases), changed(off, dict.fromkeys(EFFECTS, of[ALL]))
        result[f"{method}, each effect alone"] = [
            {"on": NONE} | _rounded(of[NONE], FIGURES),
            *({"on": name} | _rounded(single[name], FIGURES) | {"changes": added[name]} for name in EFFECTS),
            {"on": ALL} | _rounded(of[ALL], FIGURES),
        ]
        runs = [cost for case, cost in of.items() if case.startswith(ALL)]
        result[f"{method}, each effect off"] = [
            {"off": NONE} | _rounded(of[ALL], MEASURED),
            {"off": "(scatter over runs)"} | {name: round(_scatter(runs, name), 3) for name in MEASURED},
            *({"off": name} | _rounded(off[name], MEASURED) | {"changes": removed[name]} for name in EFFECTS),
        ]
    return result


def changed(costs: Mapping[str, Cost], bases: Mapping[str, Cost]) -> dict[str, str]:
    """Which measured figures each effect changes, beyond `margin_of_error` and by more than ``NEGLIGIBLE_UM``.

    Parameters
    ----------
    costs, bases : mapping
        Of each effect: with and without it, in the same run.

    Returns
    -------
    dict
        For each effect the figures' names without their unit, separated by commas.
    """
    found: dict[str, list[str]] = {effect: [] for effect in costs}
    for name in MEASURED:
        changes = {effect: getattr(costs[effect], name) - getattr(bases[effect], name) for effect in costs}
        known = np.array([change for change in changes.values() if np.isfinite(change)])
        limit = max(NEGLIGIBLE_UM, margin_of_error(known)) if len(known) else NEGLIGIBLE_UM
        for effect, change in changes.items():
            if abs(change) > limit:
                found[effect].append(name.removesuffix("_um"))
    return {effect: ", ".join(names) for effect, names in found.items()}


def margin_of_error(changes: np.ndarray) -> float:
    """How large a change of one figure can be by chance, from its changes (effects,) by all effects.

    Cases of one run share their noise, so that it is not their scatter over runs that counts. As most effects leave a
    figure alone, the middle of its changes tells chance from them: Lenth's pseudo standard error, 1.5 times the median
    of the absolute changes without those beyond 2.5 times that of all, with Student's t of a third as many degrees of
    freedom as there are changes (Technometrics 31, 1989). It holds at ``FALSE_ALARM`` for a single figure if the
    changes by all effects that leave it alone are draws from one distribution.
    """
    absolute = np.abs(changes)
    inert = absolute[absolute <= 2.5 * 1.5 * np.median(absolute)]
    return float(1.5 * np.median(inert) * student.ppf(1 - FALSE_ALARM / 2, len(changes) / 3))


def _scatter(runs: Iterable[Cost], name: str) -> float:
    return float(np.std([getattr(run, name) for run in runs], ddof=1))


def _rounded(cost: Cost, names: Iterable[str]) -> Row:
    return {name: round(getattr(cost, name), 3) for name in names}
