"""What a study can run: functions that take one drawn twin through a procedure and return flat figures."""

from collections.abc import Callable, Sequence
from importlib import import_module

Figures = dict[str, float | str]
"""One line: numbers, whose names end in their units, and texts that tell the line from others, such as a method."""

Experiment = Callable[[str, Sequence[str], str, Callable[[float], None]], list[Figures]]
"""Called with (rig_name, overrides, run, advance) as ``greenough.twin.open`` takes them; ``advance`` may be called with
steps of progress. It raises InputError where this draw cannot be calibrated or measured."""

KINDS = {
    "calibrations": "greenough.twin.validation.calibration_comparison:comparison_figures",
    "coverage": "greenough.twin.validation.rendered_captures:rendered_coverage",
    "coverage-observed": "greenough.twin.validation.observed_captures:observed_coverage",
    "cost": "greenough.twin.validation.cost:cost_figures",
    "negative-controls": "greenough.twin.validation.negative_controls:control_figures",
}
"""Names of the experiments that come with the package, as ``package.module:function``."""


def experiment(kind: str) -> Experiment:
    """The function behind a name of ``KINDS`` or a ``package.module:function`` of one's own, see ``exists``."""
    module, _, function = KINDS.get(kind, kind).partition(":")
    return getattr(import_module(module), function)


def exists(kind: str) -> bool:
    """Whether there is an experiment of that name; one that is there and fails to import raises as it does."""
    module, _, function = kind.partition(":")
    if kind in KINDS or not function:
        return kind in KINDS
    try:
        return hasattr(import_module(module), function)
    except ModuleNotFoundError as error:
        if error.name is None or not f"{module}.".startswith(f"{error.name}."):
            raise
        return False
