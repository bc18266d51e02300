"""Flatness of points about their least-squares plane, after VDI/VDE 2634-2."""

from dataclasses import dataclass

import numpy as np

from greenough.instrument.errors import InputError

from .form_error import FormError, without_worst

_IN_LINE = 1e-9  # second over first singular value below which points lie on one line


@dataclass(frozen=True, eq=False)
class Plane:
    """A fitted plane.

    Parameters
    ----------
    point : (3,) float64
        On the plane: the points' weighted mean.
    normal : (3,) float64
        Of length 1, upwards.
    residuals : (n,) float64
        Distances of the points from the plane along the normal, mm.
    """

    point: np.ndarray
    normal: np.ndarray
    residuals: np.ndarray

    @property
    def n(self) -> int:
        """Points that it was fitted to."""
        return len(self.residuals)

    def distances(self, points: np.ndarray) -> np.ndarray:
        """Distances (...,) of points (..., 3), positive on the normal's side."""
        return (points - self.point) @ self.normal

    def levelled(self, points: np.ndarray) -> np.ndarray:
        """Points (..., 3) about ``point``, the plane turned into the horizontal the shortest way: z is the distance."""
        a, b, c = self.normal
        # Rodrigues' rotation that takes the normal to (0, 0, 1); c is its cosine and not negative.
        rotation = np.array([[1 - a * a / (1 + c), -a * b / (1 + c), -a], [-a * b / (1 + c), 1 - b * b / (1 + c), -b]])
        return (points - self.point) @ np.vstack([rotation, self.normal]).T


def fit_plane(points: np.ndarray, sigma: np.ndarray | None = None) -> Plane:
    """The plane with the least sum of squared distances of points along its normal.

    It goes through their weighted mean; its normal is the last right singular vector of what is left without that.

    Parameters
    ----------
    points : (n, 3)
        mm; finite.
    sigma : (n,), optional
        Standard deviation of each point along the normal, mm: weights are 1 / sigma².

    Raises
    ------
    InputError
        If there are fewer than 4 points, a number is not finite, a sigma is not positive, or all points lie on a line.
    """
    points = np.asarray(points, dtype=float)
    if points.ndim != 2 or points.shape[1] != 3 or len(points) < 4:
        raise InputError(f"a plane needs at least 4 points (n, 3), but the array has shape {points.shape}")
    if not np.isfinite(points).all():
        raise InputError("a plane's points must be finite: leave out those that were not measured")
    if sigma is not None and not (np.shape(sigma) == (len(points),) and np.all(np.asarray(sigma) > 0)):
        raise InputError(f"sigma must be one positive number for each of the {len(points)} points of the plane")
    weight = np.ones(len(points)) if sigma is None else 1 / np.asarray(sigma, dtype=float)
    middle = np.average(points, axis=0, weights=weight**2)
    offset = points - middle
    singular, axes = np.linalg.svd(offset * weight[:, None], full_matrices=False)[1:]
    if not singular[1] > _IN_LINE * singular[0]:
        raise InputError(f"the {len(points)} points lie on one line and determine no plane: spread them over an area")
    normal = axes[2] if axes[2, 2] >= 0 else -axes[2]
    return Plane(middle, normal, offset @ normal)


@dataclass(frozen=True, eq=False)
class Flatness:
    """Flatness of a measured plane, after VDI/VDE 2634-2.

    Parameters
    ----------
    plane : Plane
        Least-squares plane of the points that count.
    form : FormError
        ``range_all`` is the flatness error, ``range_95`` that of the central 95 % of the points.
    """

    plane: Plane
    form: FormError


def flatness(points: np.ndarray, sigma: np.ndarray | None = None, discarded_share: float = 0.0) -> Flatness:
    """Flatness error of points on a plane.

    Parameters
    ----------
    points, sigma
        As in :func:`fit_plane`.
    discarded_share : float
        Share of the points, at most 3 per mille, that may be left out: the farthest from the plane of all. The plane is
        then fitted anew.

    Raises
    ------
    InputError
        As from :func:`fit_plane`, and for a share out of range.
    """
    points = np.asarray(points, dtype=float)
    plane = fit_plane(points, sigma)
    kept = without_worst(plane.residuals, discarded_share)
    discarded = int(np.sum(~kept))
    if discarded:
        plane = fit_plane(points[kept], None if sigma is None else np.asarray(sigma)[kept])
    return Flatness(plane, FormError.of(plane.residuals, discarded))
