"""A diaphragm in its states: profiles, volume against the plane of its rim, and stroke.

Everything is measured from the plane of the clamped rim of the same capture, so that it does not matter whether the
part was moved between its states. Volumes are sums over a regular grid of cells; where cells are empty nothing is
filled in: the share of the missing area is stated, with what it may hold at most.
"""

from dataclasses import dataclass

import numpy as np

from greenough.instrument.errors import InputError
from greenough.pipeline.reconstruct import PointMap

from .flatness import Plane, fit_plane

CELLS_PER_RADIUS = 50
CENTRE_SHARE = 0.1
"""The height of the centre is that of the best second-order surface over this share of the clamped radius."""

_LEAST_POINTS = 20


@dataclass(frozen=True)
class Outline:
    """Where the diaphragm lies, mm.

    Parameters
    ----------
    centre : (float, float)
        x and y in the calibrated frame.
    clamp_radius : float
        The film moves inside.
    rim_radius : float
        The rim is flat from ``clamp_radius`` to here.
    """

    centre: tuple[float, float]
    clamp_radius: float
    rim_radius: float


@dataclass(frozen=True, eq=False)
class DiaphragmState:
    """One state as measured.

    Parameters
    ----------
    rim : Plane
        Least-squares plane of the rim's points; its residuals tell how flat that is.
    heights : (cells, cells) float64
        Mean height above the rim's plane of the points in each cell, mm; NaN where none is or outside the clamped
        circle.
    inside : (cells, cells) bool
        Cells of the clamped circle.
    cell : float
        Side of a cell, mm.
    centre_height, centre_sd : float
        Height of the centre above the rim's plane and its standard deviation by the residuals of both, errors taken
        for independent.
    n_centre : int
        Points that it is from.
    """

    rim: Plane
    heights: np.ndarray
    inside: np.ndarray
    cell: float
    centre_height: float
    centre_sd: float
    n_centre: int


@dataclass(frozen=True)
class Volume:
    """Volume over the cells that were measured.

    Parameters
    ----------
    volume : float
        mm³; positive above the rim's plane, or where the second state is above the first one.
    n : int
        Cells that were measured.
    missing_share : float
        Share of the clamped circle's area that was not.
    missing_at_most : float
        mm³: the missing area times the largest height measured in any cell, to either side.
    """

    volume: float
    n: int
    missing_share: float
    missing_at_most: float


@dataclass(frozen=True)
class Stroke:
    """Displacement of the centre from a first to a second state, mm."""

    stroke: float
    sd: float
    n: tuple[int, int]


@dataclass(frozen=True, eq=False)
class Profile:
    """Heights along a row or column of the picture.

    Parameters
    ----------
    along : (n,) float64
        Place of each point on the straight line through them in the rim's plane, mm, from the foot of the outline's
        centre; NaN where nothing was measured.
    height : (n,) float64
        Above the rim's plane, mm.
    missing_share : float
        Share of the pixels between the first and the last point that have none.
    """

    along: np.ndarray
    height: np.ndarray
    missing_share: float


def measure_state(points: PointMap, outline: Outline) -> DiaphragmState:
    """Rim plane, heights above it and the centre's height of one state.

    Raises
    ------
    InputError
        If the outline is none, or rim or centre have too few points.
    """
    if not 0 < outline.clamp_radius < outline.rim_radius:
        raise InputError(
            f"a diaphragm clamped at a radius of {outline.clamp_radius:g} mm and rimmed to {outline.rim_radius:g} mm "
            "is none: the rim must be outside"
        )
    xyz = points.xyz[points.valid]
    aside = np.hypot(*(xyz[:, :2] - outline.centre).T)
    on_rim = (aside > outline.clamp_radius) & (aside < outline.rim_radius)
    if on_rim.sum() < _LEAST_POINTS:
        raise InputError(
            f"{on_rim.sum()} points lie on the diaphragm's rim: at least {_LEAST_POINTS} are needed around it"
        )
    rim = fit_plane(xyz[on_rim])
    local = _about_centre(xyz, rim, outline)
    cell = outline.clamp_radius / CELLS_PER_RADIUS
    side = 2 * CELLS_PER_RADIUS
    middles = (np.arange(side) + 0.5) * cell - outline.clamp_radius
    inside = np.hypot(middles, middles[:, None]) < outline.clamp_radius
    row, col = np.floor((local[:, [1, 0]] + outline.clamp_radius) / cell).astype(int).T
    in_grid = (row >= 0) & (row < side) & (col >= 0) & (col < side)
    index = row[in_grid] * side + col[in_grid]
    count = np.bincount(index, minlength=side * side).reshape(side, side)
    total = np.bincount(index, weights=local[in_grid, 2], minlength=side * side).reshape(side, side)
    heights = np.where(inside & (count > 0), total / np.maximum(count, 1), np.nan)
    centre_height, sd, n_centre = _centre_height(local, CENTRE_SHARE * outline.clamp_radius)
    rim_sd = np.sqrt(np.mean(rim.residuals**2) / rim.n)  # of its plane in its middle
    return DiaphragmState(rim, heights, inside, cell, centre_height, float(np.hypot(sd, rim_sd)), n_centre)


def volume(state: DiaphragmState) -> Volume:
    """Volume between the film and the plane of its rim."""
    return _volume(state.heights, state)


def volume_between(first: DiaphragmState, second: DiaphragmState) -> Volume:
    """Volume that the film sweeps from the first to the second state, over the cells that were measured in both.

    Raises
    ------
    InputError
        If the states have different outlines.
    """
    if first.cell != second.cell:
        raise InputError(
            "two states of a diaphragm must be measured with one clamped radius: give both the same outline"
        )
    return _volume(second.heights - first.heights, first)


def stroke(first: DiaphragmState, second: DiaphragmState) -> Stroke:
    """Displacement of the centre from the first to the second state."""
    return Stroke(
        second.centre_height - first.centre_height,
        float(np.hypot(first.centre_sd, second.centre_sd)),
        (first.n_centre, second.n_centre),
    )


def row_profile(points: PointMap, row: int, rim: Plane, outline: Outline) -> Profile:
    """Profile along a row of the picture."""
    return _profile(points.xyz[row], rim, outline)


def column_profile(points: PointMap, column: int, rim: Plane, outline: Outline) -> Profile:
    """Profile along a column of the picture."""
    return _profile(points.xyz[:, column], rim, outline)


def _about_centre(points: np.ndarray, rim: Plane, outline: Outline) -> np.ndarray:
    """Points (..., 3) with heights above the rim's plane, x and y in it about the centre's place on it."""
    x, y = outline.centre
    z = rim.point[2] - ((np.array([x, y]) - rim.point[:2]) @ rim.normal[:2]) / rim.normal[2]
    return rim.levelled(points) - rim.levelled(np.array([x, y, z]))


def _centre_height(local: np.ndarray, reach: float) -> tuple[float, float, int]:
    near = local[np.hypot(local[:, 0], local[:, 1]) < reach]
    if len(near) < _LEAST_POINTS:
        raise InputError(
            f"{len(near)} points lie within {reach:.3g} mm of the diaphragm's centre: at least {_LEAST_POINTS} are "
            "needed"
        )
    x, y, z = near.T
    design = np.column_stack([np.ones_like(x), x, y, x * x, x * y, y * y])
    solution = np.linalg.lstsq(design, z, rcond=None)[0]
    variance = np.sum((z - design @ solution) ** 2) / (len(z) - design.shape[1])
    return float(solution[0]), float(np.sqrt(variance * np.linalg.pinv(design.T @ design)[0, 0])), len(z)


def _volume(heights: np.ndarray, state: DiaphragmState) -> Volume:
    measured = np.isfinite(heights)
    n, cells, area = int(measured.sum()), int(state.inside.sum()), state.cell**2
    if n == 0:
        raise InputError(
            "no part of the diaphragm was measured where its volume is asked for: check exposure and outline"
        )
    return Volume(
        volume=float(heights[measured].sum() * area),
        n=n,
        missing_share=1 - n / cells,
        missing_at_most=float((cells - n) * area * np.abs(heights[measured]).max()),
    )


def _profile(points: np.ndarray, rim: Plane, outline: Outline) -> Profile:
    local = _about_centre(points, rim, outline)
    measured = np.flatnonzero(np.isfinite(local[:, 2]))
    if len(measured) < 2:
        raise InputError(f"the profile has {len(measured)} points: choose a row or column that crosses the diaphragm")
    start, end = local[measured[[0, -1]], :2]
    direction = (end - start) / np.linalg.norm(end - start)
    span = measured[-1] - measured[0] + 1
    return Profile(local[:, :2] @ direction, local[:, 2], 1 - len(measured) / float(span))
