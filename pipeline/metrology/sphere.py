"""Gauss spheres, their probing errors and the spacing of two, after VDI/VDE 2634-2.

A Gauss sphere has the least sum of squared distances of points from its surface, along the radius. The fewer degrees
of it are seen, the less its diameter is determined: every result states the half-angle of the cap of points.
"""

from dataclasses import dataclass

import numpy as np

from greenough.instrument.errors import InputError

from .form_error import FormError, without_worst

_CONVERGED_MM = 1e-9
_MAX_ITERATIONS = 100
_MAX_HALVINGS = 30
_LEAST_KNOWN = 0.5  # sd of a radius over the radius: curvature that is within two of its sd is no sphere's
_SINGULAR = 1e-10  # smallest over largest singular value below which points leave a sphere open


@dataclass(frozen=True, eq=False)
class Sphere:
    """A fitted sphere.

    Parameters
    ----------
    centre : (3,) float64
    radius : float
    covariance : (4, 4) float64
        Of the centre's coordinates and the radius, mm²: by the points' standard deviations where they were given, else
        by their scatter; errors of different points are taken for independent. The radius's row and column are 0 if it
        was fixed.
    residuals : (n,) float64
        Distances of the points from the surface, positive outside.
    cap_half_angle_deg : float
        Largest angle, seen from the centre, between a point and the mean direction of all.
    """

    centre: np.ndarray
    radius: float
    covariance: np.ndarray
    residuals: np.ndarray
    cap_half_angle_deg: float

    @property
    def n(self) -> int:
        """Points that it was fitted to."""
        return len(self.residuals)

    @property
    def diameter(self) -> float:
        """Twice the radius."""
        return 2 * self.radius

    @property
    def diameter_sd(self) -> float:
        """Standard deviation of the diameter by ``covariance``."""
        return float(2 * np.sqrt(self.covariance[3, 3]))


def fit_sphere(points: np.ndarray, sigma: np.ndarray | None = None, radius: float | None = None) -> Sphere:
    """The Gauss sphere of points, by Gauss-Newton from an algebraic start.

    The residual of a point p is |p - c| - R; its derivatives are -(p - c) / |p - c| and -1. A step that does not lower
    the sum of squares is halved; the fit has converged when no parameter changes by more than 1e-9 mm.

    Parameters
    ----------
    points : (n, 3)
        mm; finite.
    sigma : (n,), optional
        Standard deviation of each point along the radius, mm: weights are 1 / sigma².
    radius : float, optional
        Fixes the radius, so that only the centre is fitted; state it wherever the result is stated.

    Raises
    ------
    InputError
        If there are fewer points than parameters and one, a number is not finite, a sigma or the radius is not
        positive, or the points do not determine a sphere: they lie on a plane or a line, or scatter too much for their
        cap.
    """
    points = np.asarray(points, dtype=float)
    _check(points, sigma, radius)
    weight = np.ones(len(points)) if sigma is None else 1 / np.asarray(sigma, dtype=float)  # of a residual
    middle = points.mean(axis=0)
    local = points - middle  # about their mean: millimetres beside hundreds would cost digits
    free = 4 if radius is None else 3
    parameters = _algebraic(local, weight)
    if radius is not None:
        parameters[3] = radius
    parameters = _gauss_newton(local, weight, parameters, free)

    offset = local - parameters[:3]
    distance = np.linalg.norm(offset, axis=1)
    residuals = distance - parameters[3]
    design = _jacobian(offset, distance)[:, :free] * weight[:, None]
    covariance = np.zeros((4, 4))
    inverse = np.linalg.pinv(design, rcond=0)  # the normal matrix would square the condition of a small cap
    covariance[:free, :free] = inverse @ inverse.T
    if sigma is None:
        covariance *= np.sum(residuals**2) / (len(points) - free)
    if not np.sqrt(covariance[3, 3]) < _LEAST_KNOWN * parameters[3]:
        raise _undetermined(len(points))
    return Sphere(
        parameters[:3] + middle, float(parameters[3]), covariance, residuals, _cap_half_angle_deg(offset, distance)
    )


@dataclass(frozen=True, eq=False)
class ProbingError:
    """Probing error of one measured sphere, after VDI/VDE 2634-2.

    Parameters
    ----------
    sphere : Sphere
        The Gauss sphere with free radius of the points that count.
    size : float
        Its diameter less the certified one.
    form : FormError
        ``range_all`` is the probing error form, ``range_95`` that of the central 95 % of the points.
    """

    sphere: Sphere
    size: float
    form: FormError


def probing_error(
    points: np.ndarray, certified_diameter: float, sigma: np.ndarray | None = None, discarded_share: float = 0.0
) -> ProbingError:
    """Probing errors of size and form of points on a sphere.

    Parameters
    ----------
    points, sigma
        As in :func:`fit_sphere`.
    certified_diameter : float
        mm.
    discarded_share : float
        Share of the points, at most 3 per mille, that may be left out: the farthest from the Gauss sphere of all. The
        sphere is then fitted anew.

    Raises
    ------
    InputError
        As from :func:`fit_sphere`, and for a share out of range or a diameter that is not positive.
    """
    if not certified_diameter > 0:
        raise InputError(f"the sphere's certified diameter is {certified_diameter:g} mm: it must be above 0")
    points = np.asarray(points, dtype=float)
    sphere = fit_sphere(points, sigma)
    kept = without_worst(sphere.residuals, discarded_share)
    discarded = int(np.sum(~kept))
    if discarded:
        sphere = fit_sphere(points[kept], None if sigma is None else np.asarray(sigma)[kept])
    return ProbingError(sphere, sphere.diameter - certified_diameter, FormError.of(sphere.residuals, discarded))


@dataclass(frozen=True)
class SpacingError:
    """Distance of two fitted spheres' centres against the certified one.

    Parameters
    ----------
    distance : float
        Measured, mm.
    error : float
        Measured less certified.
    sd : float
        Standard deviation of the distance by the two spheres' covariances, taken for independent of one another.
    n : (int, int)
        Points on each sphere.
    """

    distance: float
    error: float
    sd: float
    n: tuple[int, int]


def spacing_error(one: Sphere, other: Sphere, certified_distance: float) -> SpacingError:
    """Sphere-spacing error |c1 - c2| - L, after VDI/VDE 2634-2.

    Raises
    ------
    InputError
        If the certified distance is not positive or the two centres coincide.
    """
    between = other.centre - one.centre
    distance = float(np.linalg.norm(between))
    if not (certified_distance > 0 and distance > 0):
        raise InputError(
            f"two spheres {distance:g} mm apart cannot be held against {certified_distance:g} mm: both must be above 0"
        )
    along = between / distance
    variance = along @ (one.covariance + other.covariance)[:3, :3] @ along
    return SpacingError(distance, distance - certified_distance, float(np.sqrt(variance)), (one.n, other.n))


def _check(points: np.ndarray, sigma: np.ndarray | None, radius: float | None) -> None:
    least = 5 if radius is None else 4
    if points.ndim != 2 or points.shape[1] != 3 or len(points) < least:
        raise InputError(f"a sphere needs at least {least} points (n, 3), but the array has shape {points.shape}")
    if not np.isfinite(points).all():
        raise InputError("a sphere's points must be finite: leave out those that were not measured")
    if sigma is not None and not (np.shape(sigma) == (len(points),) and np.all(np.asarray(sigma) > 0)):
        raise InputError(f"sigma must be one positive number for each of the {len(points)} points of the sphere")
    if radius is not None and not radius > 0:
        raise InputError(f"the sphere's radius is {radius:g} mm: it must be above 0")


def _algebraic(points: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Start (4,): |p|² = 2 c·p + (R² - |c|²) is linear in its unknowns."""
    size = np.sqrt(np.mean(points**2)) or 1.0
    scaled = points / size
    design = np.column_stack([2 * scaled, np.ones(len(points))]) * weight[:, None]
    singular = np.linalg.svd(design, compute_uv=False)
    if singular[-1] < _SINGULAR * singular[0]:
        raise _undetermined(len(points))
    solution = np.linalg.lstsq(design, np.sum(scaled**2, axis=1) * weight, rcond=None)[0]
    squared = solution[3] + solution[:3] @ solution[:3]  # of the radius: a mean of squares
    return np.append(solution[:3], np.sqrt(squared)) * size


def _gauss_newton(points: np.ndarray, weight: np.ndarray, parameters: np.ndarray, free: int) -> np.ndarray:
    """Parameters (4,) with the least sum of squares; only the first ``free`` change."""

    def weighted(at: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        offset = points - at[:3]
        distance = np.linalg.norm(offset, axis=1)
        return (distance - at[3]) * weight, offset, distance

    residual, offset, distance = weighted(parameters)
    for _ in range(_MAX_ITERATIONS):
        if not distance.min() > 0:
            break
        design = _jacobian(offset, distance)[:, :free] * weight[:, None]
        step = np.zeros(4)
        step[:free] = np.linalg.lstsq(design, -residual, rcond=None)[0]
        for _ in range(_MAX_HALVINGS):
            if np.abs(step).max() <= _CONVERGED_MM:
                return parameters + step
            tried = weighted(parameters + step)
            if tried[0] @ tried[0] < residual @ residual:
                break
            step /= 2
        else:
            break
        parameters = parameters + step
        residual, offset, distance = tried
    raise _undetermined(len(points))


def _jacobian(offset: np.ndarray, distance: np.ndarray) -> np.ndarray:
    """Derivatives (n, 4) of the residuals by centre and radius."""
    return np.column_stack([-offset / distance[:, None], -np.ones(len(distance))])


def _cap_half_angle_deg(offset: np.ndarray, distance: np.ndarray) -> float:
    direction = offset / distance[:, None]
    mean = direction.mean(axis=0)
    length = np.linalg.norm(mean)
    if length == 0:
        return 180.0
    return float(np.degrees(np.arccos(np.clip((direction @ (mean / length)).min(), -1, 1))))


def _undetermined(n: int) -> InputError:
    return InputError(
        f"the {n} points do not determine a sphere: they lie on a plane or a line, or scatter too much for the small "
        "cap that they cover; take in points farther from the apex"
    )
