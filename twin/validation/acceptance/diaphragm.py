"""The diaphragm in three states: profiles along a row and a column, and stroke and volume from state to state.

Heights are perpendicular to the flange in which the film is clamped. What is true at a measured place is the formula
of the film there.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from greenough.instrument.contract import Placement
from greenough.pipeline.metrology.flatness import fit_plane
from greenough.scenes.diaphragm import CLAMP_RADIUS_MM, DEFLECTION_MM, OUTER_RADIUS_MM, surface

from ..setup import Setup
from .artefacts import Artefact, Treated, measure
from .rows import CLAIM, CLAIM_UM, Row, row

STATES = tuple(DEFLECTION_MM)
PAIRS = (*pairwise(STATES), (STATES[0], STATES[-1]))
PROFILES = {"row": (200, 960), "column": (300, 1280)}
"""The row and the column whose profiles are judged, and of how many: those of the paper."""

NAMES = tuple(
    [f"diaphragm_profile_{line}_{state}" for state in STATES for line in PROFILES]
    + [f"diaphragm_{what}_{one}_{other}" for one, other in PAIRS for what in ("stroke", "volume")]
)

ALIGNMENT = "levelled on the flange, film's axis by truth"
MIDDLE_MM = 0.2
"""Radius of the disc whose mean height is that of the film's middle."""

FIELD_MM = (3.2, 2.7)
"""Volumes are those over the film out to this radius and this |y|, which is lit in all states."""

_CELL_MM = 0.1
_FLANGE_MM = (CLAMP_RADIUS_MM + 0.05, OUTER_RADIUS_MM - 0.05)


def diaphragm_rows(setup: Setup, advance: Callable[[float], None]) -> Iterator[Row]:
    """Lay the diaphragm under the lenses in every state and judge its shape."""
    states = {}
    for state in STATES:
        states[state] = measure(setup, Placement(f"diaphragm-{state}"))
        advance(1)
    yield from rows_of_states(setup, states)


def rows_of_states(setup: Setup, states: Mapping[str, Artefact]) -> Iterator[Row]:
    """Profiles of each state, and what changes from one to another, by filtered points."""
    films = {state: _Film.of(found, found.treated[-1], DEFLECTION_MM[state]) for state, found in states.items()}
    for state, film in films.items():
        for line, (index, of) in PROFILES.items():
            lines = film.errors if line == "row" else film.errors.T
            errors = 1e3 * lines[index * len(lines) // of]
            errors = errors[np.isfinite(errors)]
            yield row(
                setup, f"diaphragm_profile_{line}_{state}",
                float(np.quantile(np.abs(errors), 0.95)) if len(errors) else np.nan, "um", len(errors),
                f"95 % of the errors' magnitudes along image {line} {index} of {of}; limit: {CLAIM}",
                limit=CLAIM_UM, filter=film.filter,
            )  # fmt: skip
    for one, other in PAIRS:
        yield from _change(setup, one, films[one], other, films[other])


@dataclass(frozen=True, eq=False)
class _Film:
    """Points on one state of the film, mm.

    ``errors`` (rows, cols) are heights less those of the formula in the film's own frame; the others, (n,), are of the
    points that are measured and judged: x, y and radius in the film's frame, heights over the flange, and true ones.
    """

    filter: str
    errors: np.ndarray
    x: np.ndarray
    y: np.ndarray
    radius: np.ndarray
    height: np.ndarray
    true: np.ndarray

    @classmethod
    def of(cls, artefact: Artefact, treated: Treated, deflection: float) -> "_Film":
        points = artefact.in_part(treated.points.xyz)
        points[~(artefact.judged & treated.points.valid)] = np.nan
        radius, azimuth = np.hypot(points[..., 0], points[..., 1]), np.arctan2(points[..., 1], points[..., 0])
        true = surface(radius, azimuth, deflection)[0]
        measured = np.isfinite(points[..., 2])
        flange = fit_plane(points[measured & (radius > _FLANGE_MM[0]) & (radius < _FLANGE_MM[1])])
        x, y = points[measured][:, :2].T
        height = flange.distances(points[measured])
        return cls(treated.filter, points[..., 2] - true, x, y, radius[measured], height, true[measured])

    def middle(self) -> tuple[float, float, int]:
        """Mean measured and true height of the middle, mm, and of how many points."""
        middle = self.radius < MIDDLE_MM
        return float(self.height[middle].mean()), float(self.true[middle].mean()), int(middle.sum())

    def cells(self) -> tuple[np.ndarray, np.ndarray]:
        """Mean measured and true heights in square cells of the field, (cells,), NaN of cells without a point."""
        count = int(np.ceil(FIELD_MM[0] / _CELL_MM))
        col, line = (np.floor(each / _CELL_MM).astype(int) + count for each in (self.x, self.y))
        inside = (np.abs(col - count + 0.5) < count) & (np.abs(line - count + 0.5) < count)
        index = line[inside] * 2 * count + col[inside]
        points = np.bincount(index, minlength=4 * count * count).astype(float)
        points[points == 0] = np.nan
        at = (np.arange(2 * count) - count + 0.5) * _CELL_MM
        in_field = ((np.hypot(at, at[:, None]) < FIELD_MM[0]) & (np.abs(at[:, None]) < FIELD_MM[1])).ravel()
        measured, true = (
            np.bincount(index, weights=each[inside], minlength=4 * count * count) / points
            for each in (self.height, self.true)
        )
        return measured[in_field], true[in_field]


def _change(setup: Setup, one: str, first: _Film, other: str, second: _Film) -> Iterator[Row]:
    (low, true_low, n_low), (high, true_high, n_high) = first.middle(), second.middle()
    yield row(
        setup, f"diaphragm_stroke_{one}_{other}", high - low, "mm", n_low + n_high,
        f"height of the middle, {other} less {one}; peer: the true one; limit of their difference: {CLAIM}",
        limit=1e-3 * CLAIM_UM, judged=high - low - true_high + true_low, peer=true_high - true_low,
        filter=first.filter, alignment=ALIGNMENT,
    )  # fmt: skip
    (low_cells, true_low_cells), (high_cells, true_high_cells) = first.cells(), second.cells()
    change, true = high_cells - low_cells, true_high_cells - true_low_cells
    seen = np.isfinite(change)
    area = float(seen.sum()) * _CELL_MM**2
    volume, true_volume = (float(np.sum(each[seen])) * _CELL_MM**2 for each in (change, true))
    yield row(
        setup, f"diaphragm_volume_{one}_{other}", volume, "mm^3", int(seen.sum()),
        f"volume within {FIELD_MM[0]:g} mm of the film's axis and |y| < {FIELD_MM[1]:g} mm, {other} less {one}; "
        f"in cells of {_CELL_MM:g} mm, {np.mean(seen):.1%} of them measured; peer: the true one; limit of their "
        f"difference: {CLAIM} over the area",
        limit=1e-3 * CLAIM_UM * area, judged=volume - true_volume, peer=true_volume, filter=first.filter,
        alignment=ALIGNMENT,
    )  # fmt: skip
