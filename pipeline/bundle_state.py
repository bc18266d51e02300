"""Everything that a bundle estimates, and the order in which its parameters stand in one vector."""

from dataclasses import dataclass

import numpy as np

from greenough.instrument.contract import SpotBoard

from .imaging_path import moved_pose
from .instrument_model import InstrumentModel


@dataclass(frozen=True, eq=False)
class BoardShape:
    """The board as drawn, and the terms by which its faces may be bent.

    Parameters
    ----------
    nominal : (spots, 2)
        In the board's frame, mm.
    radii : (spots,)
    scale_mm : float
        Unit of length of the terms x², x y, y².
    bow_terms : (spots, 3)
        Height of the printed face at each spot by a unit of each term, less the best plane: the board's frame is that
        plane's.
    """

    nominal: np.ndarray
    radii: np.ndarray
    scale_mm: float
    bow_terms: np.ndarray

    @classmethod
    def of(cls, board: SpotBoard) -> "BoardShape":
        """The terms of this board, in units of the distance to the outermost spots."""
        nominal = board.centres()
        scale = float(np.abs(nominal).max())
        terms = quadratic(nominal / scale)
        plane = np.column_stack([np.ones(len(nominal)), nominal])
        terms = terms - plane @ np.linalg.lstsq(plane, terms, rcond=None)[0]
        return cls(nominal, board.diameters() / 2, scale, terms)

    @property
    def rigid_motions(self) -> np.ndarray:
        """(3, 2 spots): unit shifts along x and y and a unit rotation of all spots."""
        x, y = self.nominal.T
        zero, one = np.zeros_like(x), np.ones_like(x)
        motions = np.stack([np.stack(pair, axis=-1).ravel() for pair in ((one, zero), (zero, one), (-y, x))])
        return motions / np.linalg.norm(motions, axis=1, keepdims=True)


@dataclass(frozen=True, eq=False)
class BundleState:
    """One value of every unknown.

    Parameters
    ----------
    instrument : InstrumentModel
    print_mm : (spots, 2)
        Printed less nominal positions.
    bow_mm : (3,)
        Of the printed face, by ``BoardShape.bow_terms``.
    world_from_board : (postures, 4, 4)
        Identity for the flat one.
    planes : (planes, 3)
        Height over the origin and slopes along x and y of each blank plane.
    shape_mm : (3,)
        Of the blank face, the same in all planes: what x², x y and y² in units of ``BoardShape.scale_mm`` add.
    offsets_rad : (postures,)
        What the projector's path had drifted by in each posture, as phase. In a plane the same would look like another
        height of it, which is free.
    """

    instrument: InstrumentModel
    print_mm: np.ndarray
    bow_mm: np.ndarray
    world_from_board: np.ndarray
    planes: np.ndarray
    shape_mm: np.ndarray
    offsets_rad: np.ndarray

    def spots(self, board: BoardShape) -> np.ndarray:
        """Centres (spots, 3) in the board's frame."""
        return np.column_stack([board.nominal + self.print_mm, board.bow_terms @ self.bow_mm])

    def plane_height(self, plane: int, board: BoardShape, xy: np.ndarray) -> np.ndarray:
        """Height (n,) of a blank plane at (n, 2) x, y in the world."""
        height, *slopes = self.planes[plane]
        return height + xy @ slopes + quadratic(xy / board.scale_mm) @ self.shape_mm

    def plane_slopes(self, plane: int, board: BoardShape, xy: np.ndarray) -> np.ndarray:
        """Its derivatives (n, 2) by x and y."""
        x, y = (xy / board.scale_mm).T
        xx, xy_, yy = self.shape_mm / board.scale_mm
        return self.planes[plane, 1:] + np.stack([2 * xx * x + xy_ * y, xy_ * x + 2 * yy * y], axis=-1)


@dataclass(frozen=True)
class Layout:
    """Where each unknown stands: instrument, print, bow, shape of the blank face, offsets of the postures' phases,
    postures but the flat one, planes.

    Parameters
    ----------
    instrument, spots, postures, planes : int
        How many parameters the instrument has, and how many there are of the others.
    reference : int
        The flat posture, which defines the world and has no parameters.
    """

    instrument: int
    spots: int
    postures: int
    planes: int
    reference: int

    @property
    def print(self) -> slice:
        return slice(self.instrument, self.instrument + 2 * self.spots)

    @property
    def bow(self) -> slice:
        return slice(self.print.stop, self.print.stop + 3)

    @property
    def shape(self) -> slice:
        return slice(self.bow.stop, self.bow.stop + 3)

    @property
    def offsets(self) -> slice:
        return slice(self.shape.stop, self.shape.stop + self.postures)

    @property
    def size(self) -> int:
        """Of the whole vector."""
        return self.offsets.stop + 6 * (self.postures - 1) + 3 * self.planes

    def posture(self, k: int) -> slice:
        """Rotation vector and shift of a posture; empty for the flat one."""
        first = self.offsets.stop + 6 * (k - (k > self.reference))
        return slice(first, first + (0 if k == self.reference else 6))

    def plane(self, k: int) -> slice:
        first = self.offsets.stop + 6 * (self.postures - 1) + 3 * k
        return slice(first, first + 3)

    def moved(self, state: BundleState, step: np.ndarray) -> BundleState:
        """The state after a step (size,)."""
        poses = state.world_from_board.copy()
        for k in range(self.postures):
            if k != self.reference:
                poses[k] = moved_pose(poses[k], step[self.posture(k)])
        return BundleState(
            instrument=state.instrument.moved(step[: self.instrument]),
            print_mm=state.print_mm + step[self.print].reshape(-1, 2),
            bow_mm=state.bow_mm + step[self.bow],
            world_from_board=poses,
            planes=state.planes + step[self.size - 3 * self.planes :].reshape(-1, 3),
            shape_mm=state.shape_mm + step[self.shape],
            offsets_rad=state.offsets_rad + step[self.offsets],
        )


def quadratic(points: np.ndarray) -> np.ndarray:
    """x², x y and y² of points (n, 2): (n, 3)."""
    x, y = points.T
    return np.stack([x * x, x * y, y * y], axis=-1)
