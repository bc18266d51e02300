"""What each effect costs, once with everything else on and once with everything else off: the cases and the tables."""

from collections.abc import Mapping, Sequence
from typing import Annotated

import numpy as np
from pydantic import BaseModel, ConfigDict, Field
from scipy.stats import t as student

ALL, NONE = "everything", "nothing"

FALSE_ALARM = 0.01
"""Chance, about, that a figure which an effect leaves alone counts as changed, where all such changes are alike.

The bundle's are not: one switch leaves its frames nearly as they were, another draws all of them anew. There the names
are no evidence, and the scatter over runs is what to compare with.
"""

NEGLIGIBLE_UM = 0.01
"""Changes below it are not named."""

Overrides = tuple[Annotated[str, Field(pattern=r"^[\w.]+=", examples=["twin.stage.position_sd_um=10"])], ...]
"""Settings that replace those of a rig file."""

Means = Mapping[str, float]
"""Figures of one line, by name."""

TableRow = dict[str, str | float]


class Effect(BaseModel):
    """What can be switched off, a line of ``[effects]``.

    ``off`` are the overrides of the rig file that switch it off; ``within`` is the effect without which it does
    nothing.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")
    off: Annotated[Overrides, Field(min_length=1, max_length=100)]
    within: Annotated[str, Field(min_length=1, max_length=200)] | None = None


def without(name: str) -> str:
    """The case with every effect but one."""
    return f"all but {name}"


def alone(name: str, effect: Effect) -> str:
    """The case with one effect, and the one without which it does nothing."""
    return f"{name} alone" if effect.within is None else f"{name} alone, in {effect.within}"


def cases_of(effects: Mapping[str, Effect]) -> dict[str, tuple[str, ...]]:
    """Everything, nothing, each effect alone and each effect off, with their overrides; none without effects."""
    if not effects:
        return {}

    def only(*kept: str | None) -> tuple[str, ...]:
        return tuple(setting for name, effect in effects.items() if name not in kept for setting in effect.off)

    cases: dict[str, tuple[str, ...]] = {ALL: (), NONE: only()}
    cases |= {alone(name, effect): only(name, effect.within) for name, effect in effects.items()}
    return cases | {without(name): effect.off for name, effect in effects.items()}


def tables(
    effects: Mapping[str, Effect], means: Mapping[str, Means], scatter: Means
) -> tuple[list[TableRow], list[TableRow]]:
    """A table of each effect alone, and one of each effect off, which has no predictions.

    ``changes`` names the figures that an effect changes, see ``changed``: against the twin without it in the first
    table, against the twin with everything in the second. That begins with everything on and ``scatter``.

    Parameters
    ----------
    effects : mapping
    means : mapping
        Figures of every case of ``cases_of``, from runs that share their noise.
    scatter : mapping
        Standard deviations of the figures over runs with everything on.
    """
    figures = tuple(means[ALL])
    measured = tuple(name for name in figures if is_measured(name))
    bases = {
        name: means[alone(effect.within, effects[effect.within]) if effect.within else NONE]
        for name, effect in effects.items()
    }
    single = {name: means[alone(name, effect)] for name, effect in effects.items()}
    off = {name: means[without(name)] for name in effects}
    added, removed = changed(single, bases), changed(off, dict.fromkeys(effects, means[ALL]))
    return [
        {"on": NONE} | _rounded(means[NONE], figures),
        *({"on": name} | _rounded(single[name], figures) | {"changes": added[name]} for name in effects),
        {"on": ALL} | _rounded(means[ALL], figures),
    ], [
        {"off": NONE} | _rounded(means[ALL], measured),
        {"off": "(scatter over runs)"} | _rounded(scatter, measured),
        *({"off": name} | _rounded(off[name], measured) | {"changes": removed[name]} for name in effects),
    ]


def is_measured(figure: str) -> bool:
    """Whether a figure comes from frames: ``NAME_predicted_UNIT`` does not."""
    return "_predicted" not in figure


def changed(costs: Mapping[str, Means], bases: Mapping[str, Means]) -> dict[str, str]:
    """Which measured figures each effect changes, beyond `margin_of_error` and by more than ``NEGLIGIBLE_UM``.

    Parameters
    ----------
    costs, bases : mapping
        Of each effect: figures with and without it, in the same runs.

    Returns
    -------
    dict
        For each effect the figures' names without their unit, separated by commas.
    """
    found: dict[str, list[str]] = {effect: [] for effect in costs}
    for name in filter(is_measured, next(iter(bases.values()))):
        changes = {effect: costs[effect][name] - bases[effect][name] for effect in costs}
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


def _rounded(figures: Means, names: Sequence[str]) -> TableRow:
    return {name: round(figures[name], 3) for name in names}
