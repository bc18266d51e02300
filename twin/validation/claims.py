"""Claims and what was measured of them: one row each, as a file and as a table."""

import json
import math
import os
import platform
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, TypedDict

from greenough.instrument.files import atomic_path

TOSS_UP_SDS = 3.0
"""A limit within so many standard deviations of a prediction leaves open what to expect: chance decides.

Of a figure whose prediction lies just farther away, a normal deviate puts 1 in 740 on the limit's other side, if its
standard deviation is the one that is stated. The rate holds for no more than that: many rows state the spread of
sampling and of the drift that is left to chance alone, and a prediction that leaves something out may err by more."""

PACKAGES = ("greenough", "mitsuba", "drjit", "numpy", "scipy", "opencv-python-headless", "libigl")


@dataclass(frozen=True)
class Claim:
    """One row: what is claimed of what, and what was found.

    Parameters
    ----------
    claim : str
        Name that scripts rely on.
    specimen : str
        What was measured.
    paper : float or None
        The paper's figure, where it gives one.
    measured : float
        In ``unit``.
    unit : str
    n : int
        Values that the figure was made from.
    filter : str
        What was averaged or smoothed; "none" where nothing was.
    alignment : str
        "none" is the calibrated frame as it is.
    calibration : str
        Method of the calibration.
    seed : int
        The instrument.
    limit : float or None
        What the figure must keep to; None where the row only reports.
    holds : bool or None
        Whether it does; None without a limit.
    expected_to_hold : bool or None
        False only where the physics says that it cannot; ``predicted`` then says what must come instead. None without
        a limit, and where the prediction lies so near to it that chance decides (`expectation`).
    criterion : str
        The rule in words.
    predicted : float or None
        What an independent model expects of the figure, in ``unit``.
    predicted_sd : float or None
        Standard deviation of the figure about the prediction, in ``unit``: of sampling, and of what the model leaves to
        chance. None where the row states no spread.
    """

    claim: str
    specimen: str
    paper: float | None
    measured: float
    unit: str
    n: int
    filter: str
    alignment: str
    calibration: str
    seed: int
    limit: float | None
    holds: bool | None
    expected_to_hold: bool | None
    criterion: str
    predicted: float | None = None
    predicted_sd: float | None = None

    @property
    def as_expected(self) -> bool:
        """Whether the row behaves as it should: held where it should hold, failed where it cannot, or open."""
        return self.expected_to_hold is None or self.holds == self.expected_to_hold


class Prediction(TypedDict, total=False):
    """What a model expects of a row's figure, as `Claim` has it; empty where none does."""

    predicted: float
    predicted_sd: float


def expectation(predicted_to_hold: bool, margin: float, predicted_sd: float | None) -> bool | None:
    """What to expect of a row with a prediction: to hold, to fail, or either.

    Parameters
    ----------
    predicted_to_hold : bool
        Whether a figure as predicted keeps to the limit.
    margin : float
        Distance of the prediction from the limit.
    predicted_sd : float or None
        Standard deviation of the figure about the prediction. Without one nothing is left open.
    """
    if predicted_sd is not None and margin <= TOSS_UP_SDS * predicted_sd:
        return None
    return predicted_to_hold


def environment() -> dict[str, Any]:
    """What the figures were computed with."""
    return {
        "python": sys.version.split()[0],
        "platform": platform.platform(),
        "cpus": os.cpu_count(),
        "packages": {name: version(name) for name in PACKAGES},
    }


def write_claims(
    path: Path, claims: Sequence[Claim], more: Mapping[str, Any], verdict: Sequence[Mapping[str, Any]] = ()
) -> None:
    """Write ``claims.json``; it appears whole or not at all. ``more`` joins the environment.

    A figure that could not be measured (NaN) is null. Where the lines of a ``verdict`` are given, they stand first.
    """
    rows = [{name: _or_none(value) for name, value in asdict(claim).items()} for claim in claims]
    document = {"verdict": [dict(line) for line in verdict]} if verdict else {}
    document |= {"claims": rows, "environment": environment() | dict(more)}
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(document, indent=1, allow_nan=False))


def _or_none(value: Any) -> Any:
    return None if isinstance(value, float) and not math.isfinite(value) else value
