"""The diaphragm in three states: profiles along a row and a column, and stroke and volume from state to state.

Heights are above the plane of the rim in which the film is clamped. What is true at a measured place is the formula of
the film there, evaluated by the same functions: what these leave out, they leave out of both.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from greenough.instrument.contract import Placement
from greenough.pipeline.metrology.diaphragm import (
    DiaphragmState,
    Outline,
    column_profile,
    measure_state,
    row_profile,
    stroke,
    volume_between,
)
from greenough.pipeline.reconstruct import PointMap
from greenough.scenes.diaphragm import CLAMP_RADIUS_MM, DEFLECTION_MM, OUTER_RADIUS_MM, surface

from ..setup import Setup
from .artefacts import Artefact, Treated, measure
from .rows import CLAIM, CLAIM_UM, Row, row

STATES = tuple(DEFLECTION_MM)
PAIRS = (*pairwise(STATES), (STATES[0], STATES[-1]))
PROFILES = {"row": (200, 960, row_profile), "column": (300, 1280, column_profile)}
"""The row and the column whose profiles are judged, and of how many: those of the paper."""

NAMES = tuple(
    [f"diaphragm_profile_{line}_{state}" for state in STATES for line in PROFILES]
    + [f"diaphragm_{what}_{one}_{other}" for one, other in PAIRS for what in ("stroke", "volume")]
)

ALIGNMENT = "levelled on the rim, film's axis by truth"


@dataclass(frozen=True, eq=False)
class _Film:
    """One state: what was measured and judged of it, and the true heights at the same places."""

    filter: str
    outline: Outline
    points: PointMap
    true_points: PointMap
    state: DiaphragmState
    true_state: DiaphragmState

    @classmethod
    def of(cls, artefact: Artefact, treated: Treated, deflection: float) -> "_Film":
        judged = (artefact.judged & treated.points.valid)[..., None]
        points = PointMap(np.where(judged, treated.points.xyz, np.nan))
        true = artefact.in_part(points.xyz)
        radius, azimuth = np.hypot(true[..., 0], true[..., 1]), np.arctan2(true[..., 1], true[..., 0])
        true[..., 2] = surface(radius, azimuth, deflection)[0]
        true_points = PointMap(artefact.in_world(true))
        x, y, _ = artefact.world_from_part[:3, 3]
        outline = Outline((float(x), float(y)), CLAMP_RADIUS_MM, OUTER_RADIUS_MM)
        states = (measure_state(each, outline) for each in (points, true_points))
        return cls(treated.filter, outline, points, true_points, *states)


def diaphragm_rows(setup: Setup, advance: Callable[[float], None]) -> Iterator[Row]:
    """Lay the diaphragm under the lenses in every state and judge its shape."""
    states = {}
    for state in STATES:
        states[state] = measure(setup, Placement(f"diaphragm-{state}"))
        advance(1)
    yield from rows_of_states(setup, states)


def rows_of_states(setup: Setup, states: Mapping[str, Artefact]) -> Iterator[Row]:
    """What changes from one state to another, and profiles of each, by filtered points."""
    films = {state: _Film.of(found, found.treated[-1], DEFLECTION_MM[state]) for state, found in states.items()}
    for one, other in PAIRS:
        yield from _change(setup, one, films[one], other, films[other])
    for state, film in films.items():
        for line, (index, of, profile) in PROFILES.items():
            at = index * film.points.valid.shape[0 if line == "row" else 1] // of
            measured = profile(film.points, at, film.state.rim, film.outline)
            true = profile(film.true_points, at, film.true_state.rim, film.outline)
            errors = 1e3 * (measured.height - true.height)
            errors = errors[np.isfinite(errors)]
            yield row(
                setup, f"diaphragm_profile_{line}_{state}", float(np.quantile(np.abs(errors), 0.95)), "um", len(errors),
                f"95 % of the errors' magnitudes along image {line} {index} of {of}, {measured.missing_share:.1%} "
                f"of it missing; limit: {CLAIM}",
                limit=CLAIM_UM, filter=film.filter, alignment=ALIGNMENT,
            )  # fmt: skip


def _change(setup: Setup, one: str, first: _Film, other: str, second: _Film) -> Iterator[Row]:
    measured, true = stroke(first.state, second.state), stroke(first.true_state, second.true_state)
    yield row(
        setup, f"diaphragm_stroke_{one}_{other}", measured.stroke, "mm", sum(measured.n),
        f"height of the centre, {other} less {one}; u without the calibration's; peer: the true one; limit of their "
        f"difference: {CLAIM}",
        limit=1e-3 * CLAIM_UM, judged=measured.stroke - true.stroke, peer=true.stroke, u=measured.sd,
        filter=first.filter, alignment=ALIGNMENT,
    )  # fmt: skip
    swept, truly = volume_between(first.state, second.state), volume_between(first.true_state, second.true_state)
    yield row(
        setup, f"diaphragm_volume_{one}_{other}", swept.volume, "mm^3", swept.n,
        f"volume that the film sweeps, {other} less {one}, in cells without the {swept.missing_share:.1%} that one of "
        f"the states lacks; peer: the true one of the same cells; limit of their difference: {CLAIM} over the area",
        limit=1e-3 * CLAIM_UM * swept.n * first.state.cell**2, judged=swept.volume - truly.volume, peer=truly.volume,
        filter=first.filter, alignment=ALIGNMENT,
    )  # fmt: skip
