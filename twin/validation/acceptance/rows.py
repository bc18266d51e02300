"""One row of the acceptance table, and where its limits come from.

The instrument's claim is a depth accuracy of about 4 um in its volume: 95 % of the errors stay within ± 4 um. From it
follow the limits of lengths and of the spread of points: the central 95 % within 8 um, and all N points within what N
normal deviates with the same central 95 % span. The other limits come from the paper, from drawings, from standard
uncertainties, or are tolerances that were chosen; each row's criterion says which. One rule was made after a run had
failed without it: which diameters of balls are judged at all, `ball_grid.LEAST_CAP_DEG`.
"""

import math
from dataclasses import dataclass

from scipy.stats import norm

from ..setup import NO_FILTER, Setup

CLAIM_UM = 4.0
CLAIM = f"the instrument's claim of {CLAIM_UM:g} um"

COVERAGE = 3.0
"""Standard uncertainties that a figure without a claim may be off: one in 370 is by chance."""

_CENTRAL_SDS = 2 * float(norm.ppf(0.975))  # that the central 95 % of normal deviates span


@dataclass(frozen=True)
class Row:
    """A figure, what it is held against, and what it must keep to.

    Parameters
    ----------
    name : str
        That scripts rely on.
    value : float
        In ``unit``; NaN where it could not be measured, and such a row does not hold.
    unit : str
    peer : float or None
        What the value is compared with, in ``unit``: a certified or a predicted one, as the criterion says.
    ratio : float or None
        Value over peer.
    limit : float or None
        In the unit of what the criterion holds against it; None where the row only reports.
    holds : bool or None
        None without a limit.
    u : float or None
        Standard uncertainty of the value, in ``unit``, by the points' scatter or stated noise, whose errors are taken
        for independent, and by the calibration unless the criterion says that it is left out. It is predicted,
        conditional on the models of both; an artefact's certificate adds none.
    n : int
        Points, marks or other values that it was made from.
    filter, alignment, calibration : str
        "none" where nothing is done to the phase or the points; the calibration's method.
    seed : int
        The instrument.
    criterion : str
        What the value is, and what must keep to the limit that comes from where.
    """

    name: str
    value: float
    unit: str
    peer: float | None
    ratio: float | None
    limit: float | None
    holds: bool | None
    u: float | None
    n: int
    filter: str
    alignment: str
    calibration: str
    seed: int
    criterion: str


def row(
    setup: Setup,
    name: str,
    value: float,
    unit: str,
    n: int,
    criterion: str,
    *,
    limit: float | None = None,
    judged: float | None = None,
    peer: float | None = None,
    u: float | None = None,
    filter: str = NO_FILTER,
    alignment: str = "none",
) -> Row:
    """A row about this instrument, which holds if |judged| <= limit; what is judged is the value unless it is given."""
    kept = abs(value if judged is None else judged)
    return Row(
        name=name,
        value=float(value),
        unit=unit,
        peer=None if peer is None else float(peer),
        ratio=float(value / peer) if peer else None,
        limit=None if limit is None else float(limit),
        holds=None if limit is None else bool(math.isfinite(value) and kept <= limit),
        u=float(u) if u is not None and math.isfinite(u) else None,
        n=int(n),
        filter=filter,
        alignment=alignment,
        calibration=setup.calibration.method,
        seed=setup.bench.settings.seed,
        criterion=criterion,
    )


def range_limit_um(n: int) -> float:
    """What ``n`` normal deviates are expected to span if the central 95 % of them span 8 um.

    Twice the expected largest of n standard normal deviates, by Blom's approximation, over 3.92.
    """
    return 2 * CLAIM_UM * expected_range(n) / _CENTRAL_SDS


def expected_range(n: int) -> float:
    """Expected difference of the largest and the smallest of ``n`` standard normal deviates."""
    return 2 * float(norm.ppf((n - 0.375) / (n + 0.25)))
