"""A ball grid array as measured: each ball's height above its substrate, its diameter and place, and coplanarity.

All is decided by the measured points and the drawing. Heights are robust, as many points near the apex share them;
diameters come from the flanks and are known by the cap that was seen, which is stated with each.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.spatial import KDTree

from greenough.instrument.errors import InputError
from greenough.pipeline.reconstruct import PointMap

from .coplanarity import coplanarity, regression_plane, seating_planes
from .package_pose import BallGridDrawing, PackagePose, find_package, rigid_motion
from .sphere import Sphere, fit_sphere

APEX_CAP_DEG = 15.0
"""The apex is the top of the best paraboloid over this slope of a ball."""

FIRST_CAP_DEG, DIAMETER_CAP_DEG = 20.0, 60.0
"""The diameter is that of the Gauss sphere of the points up to the first slope, and on to the second one as far as they
were seen and lie on one sphere."""

MISSING_BELOW = 0.25
"""Share of the drawn height: where the median height in a ball's core is lower, no ball is there."""

STRAY = 5.0
"""Points farther from a fitted surface than this many robust standard deviations of all are left out of its fit."""

_LEAST_POINTS = 10  # of a cap, or of a ball's surroundings
_CORE = 0.25  # of a diameter: what lies nearer to a ball's place says whether it is there
_SKIRT = 0.65  # of a diameter: nearer to a place, points may be the ball's flank or in its shade
_SURROUNDINGS = 0.8  # of the pitch: substrate farther from a place than this is not the ball's own
_FLAT_SHARE = 0.15  # of the drawn height: substrate does not lie farther from the package's plane
_FAR = 0.15  # of a diameter: what lies farther from a nominal ball was not seen in direct light
_RING_DEG = 5.0
_AGREES = 5.0  # standard deviations
_ROUNDS = 3
_SD_PER_MAD = 1.4826
_EXACT_MM = 1e-6  # noise of points that have none


@dataclass(frozen=True, eq=False)
class BallGridMeasurement:
    """What was measured on a package; arrays are in the order of the drawing's places, NaN where unknown.

    Parameters
    ----------
    pose : PackagePose
        In the end fitted to the spheres' centres.
    missing : (balls,) bool
        Substrate was seen where the ball should be.
    unseen : (balls,) bool
        Too little was measured to say, or what was has no top: blur that is not taken out tilts a shiny ball's cap.
    low : (balls,) bool
        The height is below the drawn one by more than its tolerance.
    height, height_sd : (balls,) float64
        Of the apex above the substrate around the ball, perpendicular to it, and its standard deviation by the fits'
        residuals, errors taken for independent.
    diameter, diameter_sd : (balls,) float64
        Of the Gauss sphere; errors that neighbouring points share, as a filter's or stray light's, are not in the sd.
    cap_half_angle_deg : (balls,) float64
        Of the points that the diameter is from.
    offset : (balls, 2) float64
        Sphere's centre less the drawn place, in the drawing's frame.
    apexes : (balls, 3) float64
        In the drawing's frame: z above the one plane of the whole substrate, its warpage left in.
    n_apex, n_sphere, n_substrate : (balls,) int
        Points behind height, diameter, and substrate.
    stray : (balls,) int
        Points of the cap that were left out of the sphere.
    seating_coplanarity, regression_coplanarity : float
        By either plane of JESD22-B108, over the balls that are there; NaN if one is unseen, as it may be the worst, or
        the package does not stand on those that are there.
    """

    pose: PackagePose
    missing: np.ndarray
    unseen: np.ndarray
    low: np.ndarray
    height: np.ndarray
    height_sd: np.ndarray
    diameter: np.ndarray
    diameter_sd: np.ndarray
    cap_half_angle_deg: np.ndarray
    offset: np.ndarray
    apexes: np.ndarray
    n_apex: np.ndarray
    n_sphere: np.ndarray
    n_substrate: np.ndarray
    stray: np.ndarray
    seating_coplanarity: float
    regression_coplanarity: float

    @property
    def measured(self) -> np.ndarray:
        """Balls with a height, (balls,) bool."""
        return np.isfinite(self.height)


def measure_ball_grid(points: PointMap, drawing: BallGridDrawing) -> BallGridMeasurement:
    """Find a package among points and measure its balls.

    Raises
    ------
    InputError
        If the package is not found.
    """
    xyz = points.xyz[points.valid]
    pose = find_package(xyz, drawing)
    local = pose.in_drawing(xyz)
    nearest = KDTree(drawing.places).query(local[:, :2], distance_upper_bound=_SURROUNDINGS * drawing.pitch)[1]
    local, bounds = local[np.argsort(nearest)], np.searchsorted(np.sort(nearest), np.arange(len(drawing.places) + 1))
    balls = [
        _measure(local[first:end], place, drawing)
        for place, (first, end) in zip(drawing.places, pairwise(bounds), strict=True)
    ]
    return _in_array(balls, pose, drawing)


@dataclass(frozen=True, eq=False)
class _Ball:
    """One ball; without apex if it is ``missing`` or else unseen."""

    missing: bool = False
    apex: np.ndarray | None = None  # (3,)
    height: float = np.nan
    height_sd: float = np.nan
    sphere: Sphere | None = None
    n_apex: int = 0
    n_substrate: int = 0
    stray: int = 0


def _measure(near: np.ndarray, place: np.ndarray, drawing: BallGridDrawing) -> _Ball:
    """The ball at a place (2,) by the points (n, 3) nearer to it than to any other."""
    aside = np.hypot(*(near[:, :2] - place).T)
    core = near[aside < _CORE * drawing.diameter]
    if len(core) < _LEAST_POINTS:
        return _Ball()
    if np.median(core[:, 2]) < MISSING_BELOW * drawing.height:
        return _Ball(missing=True)
    radius = drawing.diameter / 2
    upper = near[(aside < radius) & (near[:, 2] > np.median(core[:, 2]) / 2)]
    found = _paraboloid_top(near, upper[:, :2].mean(axis=0), radius * np.sin(np.radians(APEX_CAP_DEG)))
    if found is None:
        return _Ball()
    apex, apex_sd, n_apex = found
    sphere, stray = _cap_sphere(near, apex - [0.0, 0.0, radius], radius)
    around = near[(aside > _SKIRT * drawing.diameter) & (np.abs(near[:, 2]) < _FLAT_SHARE * drawing.height)]
    x, y = (around[:, :2] - apex[:2]).T
    substrate = _trimmed_fit(np.column_stack([np.ones_like(x), x, y]), around[:, 2])
    if substrate is None:
        return _Ball(apex=apex, sphere=sphere, n_apex=n_apex, stray=stray)
    (below, a, b), below_sd, n_substrate = substrate
    height = float((apex[2] - below) / np.sqrt(1 + a * a + b * b))
    return _Ball(False, apex, height, float(np.hypot(apex_sd, below_sd)), sphere, n_apex, n_substrate, stray)


def _cap_sphere(near: np.ndarray, centre: np.ndarray, radius: float) -> tuple[Sphere | None, int]:
    """Gauss sphere of the points (n, 3) on a ball's cap, from a start, and how many strays it leaves out there.

    The cap grows from the apex, ring by ring, as long as the next ring lies on the sphere so far: its median residual
    within what that sphere's covariance and the noise leave, its scatter no more than twice the first cap's. Light that
    came by way of a neighbour, and blur at the foot, would make a sphere of their own.
    """
    slopes = np.radians(np.arange(FIRST_CAP_DEG, DIAMETER_CAP_DEG + 1e-9, _RING_DEG))
    first = _first_cap(near, centre, radius, slopes[0])
    if first is None:
        return None, 0
    sphere, stray, noise = first
    for inner, outer in pairwise(slopes):
        offset = near - sphere.centre
        aside, distance = np.hypot(offset[:, 0], offset[:, 1]), np.linalg.norm(offset, axis=1)
        ring = (aside >= sphere.radius * np.sin(inner)) & (aside < sphere.radius * np.sin(outer)) & (offset[:, 2] > 0)
        n = int(ring.sum())
        if n < _LEAST_POINTS:
            break
        residual = distance[ring] - sphere.radius
        middle = np.median(residual)
        by_sphere = -np.append(np.mean(offset[ring] / distance[ring, None], axis=0), 1.0)
        left = by_sphere @ sphere.covariance @ by_sphere + np.pi / 2 * noise**2 / n  # a median's variance
        scatter = _SD_PER_MAD * np.median(np.abs(residual - middle))
        if abs(middle) > _AGREES * np.sqrt(left) or scatter > 2 * noise:
            break
        grown = _sphere_within(near, sphere.centre, sphere.radius, outer, STRAY * noise)
        if grown is None:
            break
        sphere, stray = grown
    return sphere, stray


def _first_cap(near: np.ndarray, centre: np.ndarray, radius: float, slope: float) -> tuple[Sphere, int, float] | None:
    """Gauss sphere of the first cap, its strays, and the noise of its points; None if it is no ball of the drawing."""
    found, nominal, limit = None, radius, _FAR * 2 * radius
    for _ in range(_ROUNDS):
        within = _sphere_within(near, centre, radius, slope, limit)
        if within is None or not 0.5 < within[0].radius / nominal < 2:
            return None
        sphere, stray = within
        centre, radius = sphere.centre, sphere.radius
        noise = max(_SD_PER_MAD * float(np.median(np.abs(sphere.residuals))), _EXACT_MM)
        found, limit = (sphere, stray, noise), STRAY * noise
    return found


def _sphere_within(
    near: np.ndarray, centre: np.ndarray, radius: float, slope: float, limit: float
) -> tuple[Sphere, int] | None:
    """Gauss sphere of the points up to a slope of one that is known roughly, none farther from it than ``limit``.

    With it, how many are; None if the points make no sphere.
    """
    offset = near - centre
    cap = (np.hypot(offset[:, 0], offset[:, 1]) < radius * np.sin(slope)) & (offset[:, 2] > 0)
    on_ball = cap & (np.abs(np.linalg.norm(offset, axis=1) - radius) < limit)
    if on_ball.sum() < _LEAST_POINTS:
        return None
    try:
        return fit_sphere(near[on_ball]), int(cap.sum() - on_ball.sum())
    except InputError:
        return None


def _paraboloid_top(near: np.ndarray, middle: np.ndarray, reach: float) -> tuple[np.ndarray, float, int] | None:
    """Top (3,) of the paraboloid of free height, place and curvature through points (n, 3), its sd, and how many."""
    x, y = (near[:, :2] - middle).T
    cap = np.hypot(x, y) < reach
    x, y, z = x[cap], y[cap], near[cap, 2]
    fitted = _trimmed_fit(np.column_stack([np.ones_like(x), x, y, x * x + y * y]), z)
    if fitted is None or fitted[0][3] >= 0:
        return None
    (c, a, b, k), sd, n = fitted
    aside = -np.array([a, b]) / (2 * k)
    if np.hypot(*aside) > reach:  # no top where there are points
        return None
    return np.append(middle + aside, c - (a * a + b * b) / (4 * k)), sd, n


def _trimmed_fit(design: np.ndarray, z: np.ndarray) -> tuple[np.ndarray, float, int] | None:
    """Coefficients of a least-squares fit without strays, the first one's sd, and how many points; None of too few."""
    kept = np.ones(len(z), dtype=bool)
    for _ in range(_ROUNDS):
        if kept.sum() < _LEAST_POINTS:
            return None
        solution, _, rank, _ = np.linalg.lstsq(design[kept], z[kept], rcond=None)
        if rank < design.shape[1]:
            return None
        fitted, residual = kept, z - design @ solution
        kept = np.abs(residual) <= STRAY * _SD_PER_MAD * np.median(np.abs(residual[kept]))
    used = design[fitted]
    variance = np.sum(residual[fitted] ** 2) / (len(used) - design.shape[1])
    return solution, float(np.sqrt(variance * np.linalg.inv(used.T @ used)[0, 0])), len(used)


def _in_array(balls: list[_Ball], pose: PackagePose, drawing: BallGridDrawing) -> BallGridMeasurement:
    """All balls in the drawing's frame, the grid fitted anew to the spheres' centres."""
    nowhere = np.full(3, np.nan)
    apexes = np.array([nowhere if ball.apex is None else ball.apex for ball in balls])
    spheres = [ball.sphere for ball in balls]
    centres = np.array([nowhere if sphere is None else sphere.centre for sphere in spheres])
    whole = np.isfinite(centres[:, 0])
    if whole.sum() >= 3:
        turn, shift = rigid_motion(drawing.places[whole], centres[whole, :2])
        back = np.eye(4)
        back[:2, :2], back[:2, 3] = turn.T, -turn.T @ shift
        pose = PackagePose(pose.substrate, back @ pose.drawing_from_world, int(whole.sum()))
        apexes, centres = (places @ back[:3, :3].T + back[:3, 3] for places in (apexes, centres))
    missing = np.array([ball.missing for ball in balls])
    height = np.array([ball.height for ball in balls])
    there = np.isfinite(apexes[:, 2])
    seating = regression = np.nan
    if np.all(there | missing) and there.sum() >= 3:
        standing = apexes[there]
        regression = coplanarity(standing, regression_plane(standing))
        try:
            seating = coplanarity(standing, seating_planes(standing, np.array(drawing.centre_of_gravity)))
        except InputError:  # it does not stand on those that are there
            seating = np.nan
    return BallGridMeasurement(
        pose=pose,
        missing=missing,
        unseen=~there & ~missing,
        low=height < drawing.height - drawing.height_tolerance,
        height=height,
        height_sd=np.array([ball.height_sd for ball in balls]),
        diameter=np.array([np.nan if s is None else s.diameter for s in spheres]),
        diameter_sd=np.array([np.nan if s is None else s.diameter_sd for s in spheres]),
        cap_half_angle_deg=np.array([np.nan if s is None else s.cap_half_angle_deg for s in spheres]),
        offset=centres[:, :2] - drawing.places,
        apexes=apexes,
        n_apex=np.array([ball.n_apex for ball in balls]),
        n_sphere=np.array([0 if s is None else s.n for s in spheres]),
        n_substrate=np.array([ball.n_substrate for ball in balls]),
        stray=np.array([ball.stray for ball in balls]),
        seating_coplanarity=seating,
        regression_coplanarity=regression,
    )
