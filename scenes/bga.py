"""A thin fine-pitch ball grid array: truncated solder spheres on a substrate.

z = 0 is half the nominal ball height above the substrate. Row 0 is at the top (+y), column 0 on the left (-x).
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np

from greenough.instrument.errors import InputError

from .parts import Part, Specimen
from .triangulation import grid_faces, grid_points
from .truncated_spheres import truncated_spheres

_EDGE_MM = 0.009  # length of a facet's sides; the sagitta over it is below 0.1 µm on the smallest ball
_ROUNDING_MM = 1e-9  # 0.4 + 0.05 and 0.5 - 0.05 may differ by rounding


@dataclass(frozen=True)
class BallGrid:
    """Drawing of a ball grid array, mm; diameter and height are within ± their tolerances."""

    rows: int = 7
    cols: int = 9
    pitch: float = 0.8
    diameter: float = 0.5
    diameter_tolerance: float = 0.05
    height: float = 0.4
    height_tolerance: float = 0.05
    substrate_size: tuple[float, float] = (7.4, 6.2)


NOMINAL = BallGrid()
DEFECTIVE_MISSING = ((2, 3),)
DEFECTIVE_LOW: Mapping[tuple[int, int], float] = MappingProxyType({(4, 6): 0.08})
"""Of the sample "bga-defective": a ball that is not there, and one 0.08 mm lower than it was drawn."""


def bga(
    seed: int,
    missing: Collection[tuple[int, int]] = (),
    low: Mapping[tuple[int, int], float] | None = None,
    nominal: BallGrid = NOMINAL,
) -> Specimen:
    """A ball grid array whose balls each have their own diameter and height.

    Both are drawn from normal distributions around the nominal values with a third of the tolerance as standard
    deviation, cut off at the tolerance. The same ball is drawn whatever else is missing or low.

    Parameters
    ----------
    seed : int
        Root of the balls' tolerances.
    missing : collection of (row, col)
        Balls that are not there.
    low : mapping of (row, col) to mm
        How much lower these balls are: they are of the same diameter, but sit deeper in the substrate.
    nominal : BallGrid
        The drawing.

    Returns
    -------
    Specimen
        Parts: substrate, balls. ``as_built``: ``ball_row`` and ``ball_col``, (balls,) int; ``ball_centres_mm``
        (balls, 3); ``ball_radii_mm`` and ``ball_heights_mm`` above the substrate, (balls,); ``ball_apexes_mm``
        (balls, 3).

    Raises
    ------
    InputError
        If a missing or low ball is not on the grid, a low one would rise above the substrate by less than half its
        radius, or the tolerances allow a ball that is higher than its diameter.
    """
    low = {} if low is None else low
    _check(nominal, missing, low)
    rng = np.random.default_rng(seed)
    shape = (nominal.rows, nominal.cols)
    radii = _toleranced(rng, shape, nominal.diameter, nominal.diameter_tolerance) / 2
    heights = _toleranced(rng, shape, nominal.height, nominal.height_tolerance)
    for ball, depth in low.items():
        deepest = heights[ball] - radii[ball] / 2
        if not 0 <= depth <= deepest:
            raise InputError(f"ball {ball} is made {depth:g} mm lower; it can be made 0 to {deepest:.3f} mm lower")
        heights[ball] -= depth

    present = np.ones(shape, bool)
    for row, col in missing:
        present[row, col] = False
    row, col = np.nonzero(present)
    radii, heights = radii[row, col], heights[row, col]
    base = -nominal.height / 2
    x = (col - (nominal.cols - 1) / 2) * nominal.pitch
    y = ((nominal.rows - 1) / 2 - row) * nominal.pitch
    apexes = np.stack([x, y, base + heights], axis=-1)
    centres = apexes - radii[:, None] * [0.0, 0.0, 1.0]
    return Specimen(
        "bga",
        (_substrate(nominal, base), truncated_spheres(centres, radii, base, _EDGE_MM, "solder")),
        nominal={
            "pitch_mm": nominal.pitch,
            "ball_diameter_mm": nominal.diameter,
            "ball_diameter_tolerance_mm": nominal.diameter_tolerance,
            "ball_height_mm": nominal.height,
            "ball_height_tolerance_mm": nominal.height_tolerance,
            "substrate_z_mm": base,
        },
        as_built={
            "ball_row": row,
            "ball_col": col,
            "ball_centres_mm": centres,
            "ball_radii_mm": radii,
            "ball_heights_mm": heights,
            "ball_apexes_mm": apexes,
        },
    )


def defective_bga(seed: int) -> Specimen:
    """The array of the same ``seed`` with one ball missing and one low: what an inspection has to find."""
    return replace(bga(seed, DEFECTIVE_MISSING, DEFECTIVE_LOW), name="bga-defective")


def _check(nominal: BallGrid, missing: Collection[tuple[int, int]], low: Mapping[tuple[int, int], float]) -> None:
    highest, smallest = nominal.height + nominal.height_tolerance, nominal.diameter - nominal.diameter_tolerance
    if highest > smallest + _ROUNDING_MM:
        raise InputError(
            f"the BGA's drawing allows balls {highest:g} mm high of only {smallest:g} mm diameter, which would float; "
            "lower the height or its tolerance"
        )
    for row, col in [*missing, *low]:
        if not (0 <= row < nominal.rows and 0 <= col < nominal.cols):
            raise InputError(
                f"ball ({row}, {col}) is not on the BGA; rows are 0 to {nominal.rows - 1} and columns 0 to "
                f"{nominal.cols - 1}"
            )


def _toleranced(rng: np.random.Generator, shape: tuple[int, int], middle: float, tolerance: float) -> np.ndarray:
    return middle + np.clip(rng.standard_normal(shape) / 3, -1, 1) * tolerance


def _substrate(nominal: BallGrid, z: float) -> Part:
    width, height = nominal.substrate_size
    xy = grid_points(np.array([-0.5, 0.5]) * width, np.array([-0.5, 0.5]) * height)
    vertices = np.column_stack([xy, np.full(len(xy), z)])
    return Part(vertices, grid_faces(2, 2), np.tile([0.0, 0.0, 1.0], (len(xy), 1)), "substrate")
