"""How a package with balls lies under the microscope: its substrate's plane and its grid, from data and drawing alone.

The drawing's frame has x and y in the substrate, z towards the balls, and its origin where the drawing puts it. As
balls do not tell one end of a symmetric grid from the other, the package is taken for turned by at most 45 degrees.
"""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import convolve
from scipy.signal import fftconvolve

from greenough.instrument.errors import InputError

from .flatness import Plane, fit_plane

LARGEST_TURN_DEG = 45.0

_SUBSTRATE_SHARE = 0.1  # of the ball height: what lies closer to the strongest plane is substrate, warpage included
_TALL_SHARE = 0.5  # of the ball height: what lies higher is ball
_TRIPLES, _SAMPLE = 500, 5000  # planes tried, and points that each is held against
_LEAST_SUBSTRATE = 100
_CELLS_PER_BALL = 8  # of the coarse picture of what is tall and what is not
_TURN_STEP_DEG = 2.0
_MARGIN = 0.5  # balls by which the grid must fit better in its place than in any other
_ROUNDS = 4
_LEAST_BALLS = 3


@dataclass(frozen=True, eq=False)
class BallGridDrawing:
    """What the drawing of a ball grid array says, mm.

    Parameters
    ----------
    places : (balls, 2) float64
        Nominal places of the balls that should be there.
    diameter, height : float
        Nominal diameter, and height of the apex above the substrate.
    height_tolerance : float
        Balls lower than ``height`` by more than this are low.
    centre_of_gravity : (float, float)
        Of the package, projected onto the substrate.
    """

    places: np.ndarray
    diameter: float
    height: float
    height_tolerance: float
    centre_of_gravity: tuple[float, float] = (0.0, 0.0)

    @classmethod
    def rectangular(
        cls, rows: int, cols: int, pitch: float, diameter: float, height: float, height_tolerance: float
    ) -> "BallGridDrawing":
        """A full array about the package's centre, row by row from the top left, x to the right, y upwards."""
        row, col = np.divmod(np.arange(rows * cols), cols)
        places = np.stack([(col - (cols - 1) / 2) * pitch, ((rows - 1) / 2 - row) * pitch], axis=-1)
        return cls(places, diameter, height, height_tolerance)

    @property
    def pitch(self) -> float:
        """Smallest distance of two places."""
        apart = np.linalg.norm(self.places[:, None] - self.places[None], axis=-1)
        return float(apart[~np.eye(len(apart), dtype=bool)].min())


@dataclass(frozen=True, eq=False)
class PackagePose:
    """Where a package lies.

    Parameters
    ----------
    substrate : Plane
        Least-squares plane of the substrate's points.
    drawing_from_world : (4, 4) float64
        Into the drawing's frame.
    balls_matched : int
        Balls that the grid was fitted to.
    """

    substrate: Plane
    drawing_from_world: np.ndarray
    balls_matched: int

    def in_drawing(self, points: np.ndarray) -> np.ndarray:
        """World points (..., 3) in the drawing's frame."""
        return points @ self.drawing_from_world[:3, :3].T + self.drawing_from_world[:3, 3]


def find_package(points: np.ndarray, drawing: BallGridDrawing) -> PackagePose:
    """Pose of a package from points (n, 3) on and around it.

    The substrate is the plane, of those through random triples of points, with the most points within a tenth of a
    ball's height, those less that are below it by up to that height; it is refitted to its points. The grid is laid
    where most of what is tall lies in its balls, over all shifts and turns in steps; then it is fitted to the middles
    of what is tall by a rigid motion.

    Raises
    ------
    InputError
        If no plane has points enough, fewer than three balls of the drawing are found, or the grid fits as well in
        another place, as where an outer row is out of the field.
    """
    substrate = _substrate_plane(points, drawing.height)
    level = substrate.levelled(points)
    tall = (level[:, 2] > _TALL_SHARE * drawing.height) & (level[:, 2] < 2 * drawing.height)
    tall_xy = level[tall, :2]
    if len(tall_xy) == 0:
        raise _not_found(0, len(drawing.places))
    turn, shift = _coarse_grid(tall_xy, drawing)
    matched = 0
    for _ in range(_ROUNDS):
        middles = _middles(tall_xy, drawing.places @ turn.T + shift, drawing.diameter)
        seen = np.isfinite(middles[:, 0])
        matched = int(seen.sum())
        if matched < _LEAST_BALLS:
            raise _not_found(matched, len(drawing.places))
        turn, shift = rigid_motion(drawing.places[seen], middles[seen])
    # world -> levelled about the substrate's point -> drawing
    to_level = substrate.levelled(np.vstack([np.eye(3), np.zeros(3)]) + substrate.point)
    rotation = np.eye(3)
    rotation[:2, :2] = turn.T
    transform = np.eye(4)
    transform[:3, :3] = rotation @ (to_level[:3] - to_level[3]).T
    transform[:3, 3] = -transform[:3, :3] @ substrate.point - np.append(turn.T @ shift, 0.0)
    return PackagePose(substrate, transform, matched)


def rigid_motion(start: np.ndarray, to: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotation (2, 2) and shift (2,) that take places (n, 2) best onto others, in the least-squares sense."""
    a, b = start - start.mean(axis=0), to - to.mean(axis=0)
    angle = np.arctan2(np.sum(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]), np.sum(a * b))
    rotation = turn_by(float(angle))
    return rotation, to.mean(axis=0) - rotation @ start.mean(axis=0)


def turn_by(angle: float) -> np.ndarray:
    """Rotation in the plane, (2, 2)."""
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


def _substrate_plane(points: np.ndarray, height: float) -> Plane:
    tolerance = _SUBSTRATE_SHARE * height
    rng = np.random.default_rng(0)  # the same points give the same plane
    sample = points[rng.choice(len(points), min(_SAMPLE, len(points)), replace=False)]
    if len(sample) < _LEAST_SUBSTRATE:
        raise InputError(
            f"{len(points)} points show no package: at least {_LEAST_SUBSTRATE} on its substrate are needed"
        )
    corners = sample[rng.integers(0, len(sample), (_TRIPLES, 3))]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    spanning = lengths > 0
    normals = normals[spanning] / lengths[spanning, None]
    if len(normals) == 0:
        raise InputError("the points lie on one line and show no package: measure an area")
    normals[normals[:, 2] < 0] *= -1
    votes = []
    for normal, offset in zip(normals, np.einsum("nk,nk->n", normals, corners[spanning, 0]), strict=True):
        above = sample @ normal - offset
        # A plane through the balls' tops has their flanks and the substrate below; a table is farther down.
        votes.append(np.sum(np.abs(above) < tolerance) - np.sum((above < -tolerance) & (above > -height)))
    best = int(np.argmax(votes))
    on_plane = np.abs((points - corners[spanning][best, 0]) @ normals[best]) < tolerance
    for _ in range(2):
        plane = fit_plane(points[on_plane])
        on_plane = np.abs(plane.distances(points)) < tolerance
    if on_plane.sum() < _LEAST_SUBSTRATE:
        raise InputError(
            f"{on_plane.sum()} points lie on the package's substrate and at least {_LEAST_SUBSTRATE} are needed: light "
            "it so that the space between the balls is measured"
        )
    return fit_plane(points[on_plane])


def _coarse_grid(tall: np.ndarray, drawing: BallGridDrawing) -> tuple[np.ndarray, np.ndarray]:
    """Turn (2, 2) and shift (2,) of the drawing's places among tall points (n, 2): where most balls are filled."""
    cell = drawing.diameter / _CELLS_PER_BALL
    low = tall.min(axis=0) - drawing.diameter
    index = ((tall - low) / cell).astype(int)
    filled = np.zeros(index.max(axis=0) + 2 * _CELLS_PER_BALL)
    filled[tuple(index.T)] = 1
    offset = np.arange(-_CELLS_PER_BALL // 2, _CELLS_PER_BALL // 2 + 1)
    disc = (np.hypot(offset, offset[:, None]) <= _CELLS_PER_BALL / 2).astype(float)
    balls = convolve(filled, disc / disc.sum(), mode="constant")
    fits = []
    for angle in np.radians(np.arange(-LARGEST_TURN_DEG, LARGEST_TURN_DEG + 1e-9, _TURN_STEP_DEG)):
        turned = drawing.places @ turn_by(angle).T
        index = np.rint((turned - turned.min(axis=0)) / cell).astype(int)
        comb = np.zeros(index.max(axis=0) + 1)
        comb[tuple(index.T)] = 1
        scores = fftconvolve(balls, comb[::-1, ::-1], mode="full")  # in balls
        corner = np.indices(scores.shape).transpose(1, 2, 0) - np.array(comb.shape) + 1
        fits.append((angle, scores, low + (corner + 0.5) * cell - turned.min(axis=0)))
    # Of two turns that fit alike, the smaller one.
    angle, scores, shifts = max(fits, key=lambda fit: fit[1].max() - 1e-3 * abs(fit[0]))
    best, shift = scores.max(), shifts[np.unravel_index(scores.argmax(), scores.shape)]
    middle = drawing.places.mean(axis=0)
    for other, other_scores, other_shifts in fits:
        apart = other_shifts + turn_by(other) @ middle - shift - turn_by(angle) @ middle
        if np.max(other_scores, where=np.linalg.norm(apart, axis=-1) > drawing.pitch / 2, initial=0) > best - _MARGIN:
            raise InputError(
                f"the drawing's {len(drawing.places)} balls fit what was measured in more than one place: bring the "
                "whole package into the field, with balls in every outer row"
            )
    return turn_by(angle), shift


def _middles(tall: np.ndarray, places: np.ndarray, diameter: float) -> np.ndarray:
    """Mean of the tall points (n, 2) within half a diameter of each place (balls, 2); NaN where these are too few.

    A point of another ball is never that near, and half a disc would pull the mean aside by less than the next round
    takes back.
    """
    middles = np.full(places.shape, np.nan)
    for k, place in enumerate(places):
        near = np.sum((tall - place) ** 2, axis=1) < (diameter / 2) ** 2
        if near.sum() >= 10:
            middles[k] = tall[near].mean(axis=0)
    return middles


def _not_found(found: int, drawn: int) -> InputError:
    return InputError(
        f"package not found: {found} of the drawing's {drawn} balls were seen and at least {_LEAST_BALLS} are needed; "
        f"lay it balls up, turned by at most {LARGEST_TURN_DEG:g} degrees, and check the drawing"
    )
