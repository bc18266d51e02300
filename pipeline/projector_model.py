"""The projector's path from world to phase: one row of a projective camera, and a smooth residual field on top.

A projector of vertical fringes shows no rows, so of a pinhole's matrix only two rows are seen: column and depth. Their
quotient has seven parameters, whatever lies between mirrors and specimen.
"""

from dataclasses import dataclass, replace

import numpy as np

from greenough.instrument.errors import InputError

from .legendre_field import DepthField

_REWEIGHTINGS = 3
_LEAST_SHARE = 1e-9  # of the largest singular value
_LEAST_LENGTH = 1e-3  # of the longest column


@dataclass(frozen=True, eq=False)
class ProjectorModel:
    """Absolute phase of the light that reaches a point of the world.

    ``phase = q + field``, ``q = (a0 + a·x) / (1 + b·x)``. The field is taken at (q, y / (1 + b·x)), which a ray of an
    ideal projector keeps, and at the height over the world's z = 0. The row is given: whatever it lacks is smooth, and
    the field holds it.

    Parameters
    ----------
    row : (7,)
        a0 in rad, a (3) in rad/mm, b (3) in 1/mm.
    field : DepthField
    coefficients : (terms,)
        Of the field, rad.
    """

    row: np.ndarray
    field: DepthField
    coefficients: np.ndarray

    @property
    def density(self) -> float:
        """Phase per mm across the fringes at the world's origin, rad/mm."""
        return float(np.hypot(*(self.row[1:3] - self.row[0] * self.row[4:6])))

    def phase(self, xyz_world: np.ndarray) -> np.ndarray:
        """Absolute phase (n,) at points (n, 3)."""
        picture, _ = _picture(self.row, xyz_world)
        return picture[:, 0] + self.field.values(picture, xyz_world[:, 2]) @ self.coefficients

    def linearise(self, xyz_world: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Phase (n,), and its derivatives by the point (n, 3) and by the coefficients (n, terms)."""
        picture, scale = _picture(self.row, xyz_world)
        q, t = picture.T
        terms, slopes, with_z = self.field.linearise(picture, xyz_world[:, 2])
        by_picture = np.einsum("f,nfj->nj", self.coefficients, slopes)
        by_picture[:, 0] += 1.0
        a, b = self.row[1:4], self.row[4:]
        by_point = (by_picture[:, :1] * (a - q[:, None] * b) - by_picture[:, 1:] * t[:, None] * b) / scale[:, None]
        by_point[:, 1] += by_picture[:, 1] / scale
        by_point[:, 2] += with_z @ self.coefficients
        return q + terms @ self.coefficients, by_point, terms

    def by_row(self, xyz_world: np.ndarray) -> np.ndarray:
        """Derivatives (n, 7) of the phase at points (n, 3) by the numbers of the row."""
        picture, scale = _picture(self.row, xyz_world)
        q, t = picture.T
        _, slopes, _ = self.field.linearise(picture, xyz_world[:, 2])
        by_q, by_t = np.einsum("f,nfj->jn", self.coefficients, slopes)
        derivatives = np.column_stack([np.ones(len(q)), xyz_world, -q[:, None] * xyz_world])
        derivatives *= ((1.0 + by_q) / scale)[:, None]
        derivatives[:, 4:] -= (by_t * t / scale)[:, None] * xyz_world
        return derivatives

    def moved(self, step: np.ndarray) -> "ProjectorModel":
        """The projector after a step (terms,) of its coefficients."""
        return replace(self, coefficients=self.coefficients + step)


def fit_row(xyz_world: np.ndarray, phase: np.ndarray) -> np.ndarray:
    """The seven numbers of the row that fit phases (n,) at points (n, 3): a linear fit, then its residuals re-weighted.

    Raises
    ------
    InputError
        If the points do not determine the row.
    """
    shift, scale = phase.mean(), max(float(np.ptp(phase)), 1e-9)
    reduced = (phase - shift) / scale
    design = np.concatenate([np.ones((len(phase), 1)), xyz_world, -reduced[:, None] * xyz_world], axis=1)
    lengths = np.linalg.norm(design, axis=0)
    lengths = np.maximum(lengths, _LEAST_LENGTH * lengths.max())  # heights that are rounding must stay small
    solution, weight = np.zeros(7), np.ones(len(phase))
    for _ in range(_REWEIGHTINGS):  # the linear form weighs each residual by its denominator
        fitted, _, rank, _ = np.linalg.lstsq(design / lengths * weight[:, None], reduced * weight, rcond=_LEAST_SHARE)
        if rank < 7:
            raise InputError(
                "the spots' phases do not determine the projector: tilt the board by 5 to 25 degrees in different "
                "directions, and lay it into the projector's light"
            )
        solution = fitted / lengths
        weight = 1.0 / (1.0 + xyz_world @ solution[4:])
    b = solution[4:]
    return np.concatenate([[shift + scale * solution[0]], shift * b + scale * solution[1:4], b])


def projector_picture(row: np.ndarray, xyz_world: np.ndarray) -> np.ndarray:
    """Where the field is taken: (q, y / (1 + b·x)) of points (n, 3), as (n, 2) in rad and mm."""
    return _picture(row, xyz_world)[0]


def _picture(row: np.ndarray, xyz_world: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    scale = 1.0 + xyz_world @ row[4:]
    q = (row[0] + xyz_world @ row[1:4]) / scale
    return np.stack([q, xyz_world[:, 1] / scale], axis=-1), scale
