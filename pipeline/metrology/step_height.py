"""Height of a step by one regression with tilt, after ISO 5436-1 for its type A1.

Of a groove (or ridge) of width W, what counts are the middle third of its bottom and, on either side, the plateau
between W/3 and W from the edge: a window of 3 W in all, from which the edges' roundings are left out.
"""

from dataclasses import dataclass

import numpy as np

from greenough.instrument.errors import InputError


@dataclass(frozen=True)
class StepHeight:
    """A measured step.

    Parameters
    ----------
    height : float
        Plateaus less bottom, mm: positive for a groove, negative for a ridge.
    sd : float
        Its standard deviation by the residuals, whose errors are taken for independent.
    residual_rms : float
        Root mean square of what the regression leaves, mm.
    n_plateaus, n_bottom : int
        Points that count.
    slope : tuple of floats
        Tilt that the regression took out, along each coordinate.
    """

    height: float
    sd: float
    residual_rms: float
    n_plateaus: int
    n_bottom: int
    slope: tuple[float, ...]

    @property
    def n(self) -> int:
        """Points that count in all."""
        return self.n_plateaus + self.n_bottom


def groove_sides(across: np.ndarray, edges: tuple[float, float]) -> np.ndarray:
    """Where each point lies: +1 on the plateaus, -1 on the bottom, 0 where it does not count, int8 as ``across``.

    Parameters
    ----------
    across : (...,)
        Coordinate across the groove, mm.
    edges : (float, float)
        Where the groove begins and ends, W apart.

    Raises
    ------
    InputError
        If the groove has no width.
    """
    left, right = edges
    width = right - left
    if not width > 0:
        raise InputError(f"a groove from {left:g} to {right:g} mm has no width: give its edges in ascending order")
    from_middle = np.abs(np.asarray(across) - (left + right) / 2) / width
    plateaus = (from_middle >= 1 / 2 + 1 / 3) & (from_middle <= 3 / 2)
    bottom = from_middle <= 1 / 6
    return plateaus.astype(np.int8) - bottom.astype(np.int8)


def step_height(places: np.ndarray, z: np.ndarray, sides: np.ndarray) -> StepHeight:
    """Height of a step: twice h of the regression Z = a X + b + h d, or areally Z = a X + b Y + c + h d.

    Parameters
    ----------
    places : (n, 1) or (n, 2)
        Coordinates of the points of a profile, X, or of an area, X and Y; mm.
    z : (n,)
        Heights, mm; NaN where nothing was measured.
    sides : (n,) int
        d: +1 on the plateaus, -1 on the bottom, 0 where a point does not count. Those of a groove are
        :func:`groove_sides`; of a step with one edge they are the person's own to state.

    Raises
    ------
    InputError
        If the arrays do not go together, either side has no measured point, or the points do not tell step from tilt.
    """
    places, z, sides = np.asarray(places, dtype=float), np.asarray(z, dtype=float), np.asarray(sides)
    if places.ndim != 2 or places.shape[1] not in (1, 2) or z.shape != (len(places),) or sides.shape != z.shape:
        raise InputError(
            f"a step's arrays have shapes {places.shape}, {z.shape} and {sides.shape}: places must be (n, 1) or "
            "(n, 2), heights and sides (n,)"
        )
    counts = (sides != 0) & np.isfinite(z) & np.isfinite(places).all(axis=1)
    side = np.sign(sides[counts]).astype(float)
    n_plateaus, n_bottom = int(np.sum(side > 0)), int(np.sum(side < 0))
    middle = places[counts].mean(axis=0) if counts.any() else 0.0
    design = np.column_stack([side, np.ones(len(side)), places[counts] - middle])
    if (
        min(n_plateaus, n_bottom) == 0
        or len(side) <= design.shape[1]
        or np.linalg.matrix_rank(design) < design.shape[1]
    ):
        raise InputError(
            f"{n_plateaus} points on the plateaus and {n_bottom} on the bottom do not tell a step from a tilt: measure "
            "both sides over some length"
        )
    solution = np.linalg.lstsq(design, z[counts], rcond=None)[0]
    residuals = z[counts] - design @ solution
    variance = residuals @ residuals / (len(side) - design.shape[1])
    inverse = np.linalg.inv(design.T @ design)
    return StepHeight(
        height=float(2 * solution[0]),
        sd=float(2 * np.sqrt(variance * inverse[0, 0])),
        residual_rms=float(np.sqrt(np.mean(residuals**2))),
        n_plateaus=n_plateaus,
        n_bottom=n_bottom,
        slope=tuple(solution[2:].tolist()),
    )
