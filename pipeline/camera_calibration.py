"""Calibrates the camera from the spots of the board in several postures (eq. 20-22 of the paper)."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from greenough.instrument.contract import SpotBoard
from greenough.instrument.errors import InputError

from .camera_model import CameraModel
from .covariance import covariance_of, covariance_root
from .homographies import check_tilts, start_camera
from .spots import Spots

MIN_POSTURES = 6
INTRINSICS = ("fx", "fy", "skew", "cx", "cy", "k1", "k2", "p1", "p2")
_MIN_POINTS = 12  # per posture
_K2_CORNER_PX = 0.1  # prior standard deviation of what k2 moves in the picture's corner
_ROTATION_STEP, _SHIFT_STEP_MM = 1e-5, 1e-3  # of central differences
_ITERATIONS = 50
_K2 = INTRINSICS.index("k2")
_LEAST_SD_PX = 1e-4  # keeps the weights finite where pictures are perfect


@dataclass(frozen=True)
class CameraCalibration:
    """A calibrated camera and how well it is known.

    Parameters
    ----------
    camera : CameraModel
    camera_from_board : (postures, 4, 4)
        Pose of the board's nominal frame in each posture.
    reference : int
        The posture whose board frame is the world.
    residuals_px : (postures, spots, 2)
        Measured minus projected centres of ellipses; NaN where unseen.
    print_sd_mm : float
        Standard deviation, per spot and axis, of the printed against the nominal positions, from the part of the
        residuals that all postures share.
    noise_sd_px : float
        Standard deviation, per axis, of the rest of the residuals.
    covariance : (9 + 6 postures, 9 + 6 postures)
        Of the intrinsic parameters in the order of ``INTRINSICS``, then of each pose: rotation vector applied on the
        left about the board's origin, then shift, in the camera frame. It holds the spots' noise and the print errors.
    """

    camera: CameraModel
    camera_from_board: np.ndarray
    reference: int
    residuals_px: np.ndarray
    print_sd_mm: float
    noise_sd_px: float
    covariance: np.ndarray

    @property
    def camera_from_world(self) -> np.ndarray:
        """(4, 4); the world is the nominal board's frame in the reference posture."""
        return self.camera_from_board[self.reference]

    @property
    def reprojection_rmse_px(self) -> np.ndarray:
        """Root mean square of the residuals along u and along v, (2,)."""
        return np.sqrt(np.nanmean(self.residuals_px**2, axis=(0, 1)))

    def spot_heights(self, board: SpotBoard) -> np.ndarray:
        """World heights (postures, spots) of the nominal spots, mm."""
        centres = board.centres()
        nominal = np.column_stack([centres, np.zeros(len(centres)), np.ones(len(centres))])
        world_from_board = np.linalg.inv(self.camera_from_world) @ self.camera_from_board
        return (world_from_board @ nominal.T)[:, 2]

    def project(self, xyz_world: np.ndarray) -> np.ndarray:
        """Pixels (..., 2) of world points (..., 3)."""
        return _project_points(self.camera, self.camera_from_world, xyz_world)

    def projected_covariance(self, xyz_world: np.ndarray) -> np.ndarray:
        """Covariance (n, 2, 2) in px² of where world points (n, 3) are imaged, by linear propagation."""
        moved = self.projected_errors(xyz_world)
        return moved @ moved.transpose(0, 2, 1)

    def projected_errors(self, xyz_world: np.ndarray) -> np.ndarray:
        """What each of 15 independent causes does (n, 2, 15) to the image of world points (n, 3), px."""
        xyz = np.asarray(xyz_world, dtype=float)
        jacobian = _differentiate(
            lambda camera, pose: _project_points(camera, pose, xyz), self.camera, self.camera_from_world
        )
        used = _columns(self.reference)
        return jacobian @ covariance_root(self.covariance[np.ix_(used, used)])


def calibrate_camera(
    observations: Sequence[Spots | np.ndarray],
    board: SpotBoard,
    shape: tuple[int, int],
    reference: int,
    names: Sequence[str] | None = None,
) -> CameraCalibration:
    """Bundle adjustment of the camera's nine intrinsic parameters and the board's poses, spots at nominal places.

    A closed form gives a start without skew and distortion. Then Levenberg-Marquardt on the distances
    between measured and projected *ellipse* centres (so eccentricity is part of the model), each weighted by its own
    variance plus a common one that the residuals show, which is mostly the print's. The field is too narrow to
    determine k2: it has a prior about zero with a standard deviation that moves the picture's corner by 0.1 px. In
    such nearly parallel light f and the distance are known only together: judge a calibration by
    :meth:`CameraCalibration.projected_covariance`, never by f.

    The covariance counts the print errors as what they are, the same in all postures: they do not average out over
    postures as noise does. Errors of the print's rigid part are no errors: the world is the nominal grid best-fitted
    to the printed spots.

    Parameters
    ----------
    observations : sequence of Spots or (n, 2) arrays
        One per posture, in the board's order, NaN where unseen.
    shape : (rows, cols)
        Of the pictures.
    reference : int
        Index of the observation whose board frame is the world.
    names : sequence of str, optional
        What to call the postures in messages; their indices if left out.

    Raises
    ------
    InputError
        Fewer than 6 postures, a posture with fewer than 12 spots, or all postures parallel.
    """
    names = [str(k) for k in range(len(observations))] if names is None else list(names)
    centres = np.array([spots.centres_px if isinstance(spots, Spots) else spots for spots in observations], dtype=float)
    sigma = np.array(
        [spots.sigma_px if isinstance(spots, Spots) else np.zeros(len(spots)) for spots in observations], dtype=float
    )
    seen = np.all(np.isfinite(centres), axis=-1)
    _check(centres, seen, names)
    nominal, radii = board.centres(), board.diameters() / 2
    check_tilts(centres, seen, nominal, names)
    camera, poses = start_camera(centres, seen, nominal, shape)
    views = _Views(np.where(seen[..., None], centres, 0.0), seen, nominal, radii, _k2_prior_sd(camera))
    variance = np.ones(seen.shape)  # of one coordinate of one spot, (postures, spots)
    for _ in range(2):
        camera, poses = _adjust(camera, poses, views, variance)
        freedom = 1.0 - (len(INTRINSICS) + 6 * len(poses)) / (2 * seen.sum())
        mean_square = np.mean(_residuals(camera, poses, views)[seen] ** 2) / freedom
        variance = np.where(seen, sigma, 0.0) ** 2
        variance += max(mean_square - np.mean(variance[seen]), _LEAST_SD_PX**2)
    residuals = np.where(seen[..., None], _residuals(camera, poses, views), np.nan)
    print_sd, noise_sd = _split_residuals(residuals, _by_place(camera, poses, views))
    covariance = _covariance(camera, poses, views, variance, print_sd, noise_sd)
    return CameraCalibration(camera, poses, reference, residuals, print_sd, noise_sd, covariance)


@dataclass(frozen=True)
class _Views:
    """What is fitted: measured centres (postures, spots, 2), which of them count, and the board as drawn."""

    centres: np.ndarray
    seen: np.ndarray  # (postures, spots)
    nominal: np.ndarray  # (spots, 2)
    radii: np.ndarray  # (spots,)
    k2_sd: float  # prior


def _check(centres: np.ndarray, seen: np.ndarray, names: list[str]) -> None:
    if len(centres) < MIN_POSTURES:
        raise InputError(
            f"the camera cannot be calibrated from {len(centres)} postures of the board ({', '.join(names)}): at least "
            f"{MIN_POSTURES} are needed; add postures with tilts of 5 to 25 degrees in different directions"
        )
    poor = [f"{name} ({count})" for name, count in zip(names, seen.sum(axis=1), strict=True) if count < _MIN_POINTS]
    if poor:
        raise InputError(
            f"too few spots were seen in posture {', '.join(poor)}: at least {_MIN_POINTS} are needed; leave it out or "
            "lay the board more into the light"
        )


def _project_points(camera: CameraModel, camera_from_frame: np.ndarray, xyz: np.ndarray) -> np.ndarray:
    return camera.project(xyz @ camera_from_frame[:3, :3].T + camera_from_frame[:3, 3])


def _residuals(camera: CameraModel, poses: np.ndarray, views: _Views) -> np.ndarray:
    """Measured minus projected, (postures, spots, 2); zero where unseen."""
    projected = camera.project_circles(views.nominal, views.radii, poses)
    return np.where(views.seen[..., None], views.centres - projected, 0.0)


def _changed(camera: CameraModel, step: np.ndarray) -> CameraModel:
    """Camera after a step (9,) of its intrinsic parameters."""
    return replace(camera, **{name: getattr(camera, name) + float(step[k]) for k, name in enumerate(INTRINSICS)})


def _moved(poses: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Poses (..., 4, 4) after steps (..., 6) of rotation, about the board's origin, and shift."""
    moved = poses.copy()
    moved[..., :3, :3] = Rotation.from_rotvec(steps[..., :3]).as_matrix() @ poses[..., :3, :3]
    moved[..., :3, 3] += steps[..., 3:]
    return moved


def _differentiate(
    project: Callable[[CameraModel, np.ndarray], np.ndarray], camera: CameraModel, poses: np.ndarray
) -> np.ndarray:
    """Derivatives (..., 2, 15) of projected points (..., 2) by the camera and their own pose: central differences.

    Pixels are linear in each intrinsic parameter, so those derivatives are exact for any step.
    """
    corner = np.hypot(*camera.shape) / 2 / camera.fx
    intrinsic = np.diag([1.0] * 5 + [corner**-2 * 1e-3, corner**-4 * 1e-3] + [corner**-1 * 1e-3] * 2)
    motion = np.diag([_ROTATION_STEP] * 3 + [_SHIFT_STEP_MM] * 3)
    columns = [
        (project(_changed(camera, step), poses) - project(_changed(camera, -step), poses)) / (2.0 * step.sum())
        for step in intrinsic
    ]
    columns += [
        (project(camera, _moved(poses, step)) - project(camera, _moved(poses, -step))) / (2.0 * step.sum())
        for step in motion
    ]
    return np.stack(columns, axis=-1)


def _jacobians(camera: CameraModel, poses: np.ndarray, views: _Views) -> np.ndarray:
    """(postures, spots, 2, 15); zero where unseen."""
    blocks = _differentiate(lambda model, at: model.project_circles(views.nominal, views.radii, at), camera, poses)
    return np.where(views.seen[..., None, None], blocks, 0.0)


def _k2_prior_sd(camera: CameraModel) -> float:
    corner = np.hypot(*camera.shape) / 2 / camera.fx
    return _K2_CORNER_PX / (camera.fx * corner**5)


def _columns(posture: int) -> np.ndarray:
    """Where a posture's 15 parameters stand among all."""
    first = len(INTRINSICS)
    return np.r_[0:first, first + 6 * posture : first + 6 * posture + 6]


def _normal_matrix(jacobians: np.ndarray, variance: np.ndarray, k2_sd: float) -> np.ndarray:
    """Information on all parameters, (9 + 6 postures,) squared, the prior on k2 included."""
    size = len(INTRINSICS) + 6 * len(jacobians)
    normal = np.zeros((size, size))
    for k, block in enumerate(jacobians):
        flat = (block / np.sqrt(variance[k])[:, None, None]).reshape(-1, block.shape[-1])
        used = _columns(k)
        normal[np.ix_(used, used)] += flat.T @ flat
    normal[_K2, _K2] += k2_sd**-2
    return normal


def _solve(normal: np.ndarray, gradient: np.ndarray) -> np.ndarray:
    """Solve for a step by eliminating the poses, which do not see each other, from the intrinsic parameters."""
    first = len(INTRINSICS)
    starts = range(first, len(normal), 6)
    own = np.array([normal[k : k + 6, k : k + 6] for k in starts])  # (postures, 6, 6)
    cross = np.array([normal[:first, k : k + 6] for k in starts])  # (postures, 9, 6)
    transfer = np.linalg.solve(own, cross.transpose(0, 2, 1))  # (postures, 6, 9)
    alone = np.linalg.solve(own, gradient[first:].reshape(-1, 6, 1))  # (postures, 6, 1)
    reduced = normal[:first, :first] - np.sum(cross @ transfer, axis=0)
    intrinsic = np.linalg.solve(reduced, gradient[:first] - np.sum(cross @ alone, axis=0)[:, 0])
    return np.concatenate([intrinsic, (alone[..., 0] - transfer @ intrinsic).ravel()])


def _adjust(
    camera: CameraModel, poses: np.ndarray, views: _Views, variance: np.ndarray
) -> tuple[CameraModel, np.ndarray]:
    """Levenberg-Marquardt until a step is below a thousandth of the parameters' standard deviations."""

    def cost(camera: CameraModel, poses: np.ndarray) -> float:
        squares = np.sum(_residuals(camera, poses, views) ** 2, axis=-1) / variance
        return float(squares.sum() + (camera.k2 / views.k2_sd) ** 2)

    damping, now = 1e-3, cost(camera, poses)
    for _ in range(_ITERATIONS):
        jacobians = _jacobians(camera, poses, views)
        normal = _normal_matrix(jacobians, variance, views.k2_sd)
        weighted = _residuals(camera, poses, views) / variance[..., None]
        gradient = np.zeros(len(normal))
        for k, block in enumerate(jacobians):
            gradient[_columns(k)] += np.tensordot(weighted[k], block, axes=2)
        gradient[_K2] -= camera.k2 / views.k2_sd**2
        while True:
            step = _solve(normal + damping * np.diag(np.diag(normal)), gradient)
            trial_camera = _changed(camera, step[: len(INTRINSICS)])
            trial_poses = _moved(poses, step[len(INTRINSICS) :].reshape(-1, 6))
            then = cost(trial_camera, trial_poses)
            if then <= now or damping > 1e6:
                break
            damping *= 10.0
        if then > now:
            break  # at the rounding of the cost
        settled = damping < 0.01 and step @ normal @ step < 1e-6
        camera, poses, now, damping = trial_camera, trial_poses, then, 0.1 * damping
        if settled:
            break
    return camera, poses


def _by_place(camera: CameraModel, poses: np.ndarray, views: _Views) -> np.ndarray:
    """Derivatives (postures, spots, 2, 2) of the centres by the spots' places on the board, px per mm."""
    shifts = _SHIFT_STEP_MM * np.eye(2)
    ahead, behind = (
        np.stack([camera.project_circles(views.nominal + sign * shift, views.radii, poses) for shift in shifts], -1)
        for sign in (1.0, -1.0)
    )
    return (ahead - behind) / (2.0 * _SHIFT_STEP_MM)


def _split_residuals(residuals: np.ndarray, by_place: np.ndarray) -> tuple[float, float]:
    """Standard deviations of what residuals have in common over postures (mm) and of the rest (px), per axis.

    Analysis of variance by spot. Of the common part the poses and the scale take over four degrees of freedom, of the
    rest each pose takes six.
    """
    on_board = np.linalg.solve(by_place, residuals[..., None])[..., 0]  # (postures, spots, 2) mm, NaN where unseen
    counts = np.isfinite(on_board[..., 0]).sum(axis=0)
    used = counts >= 2
    on_board, counts = on_board[:, used], counts[used]
    mean = np.nanmean(on_board, axis=0)
    px_per_mm = np.sqrt(np.mean(np.abs(np.linalg.det(by_place))))
    freedom_within = 2.0 * (counts - 1).sum() - 6.0 * (len(residuals) - 1)
    within = np.nansum((on_board - mean) ** 2) / freedom_within
    between = np.sum(mean**2) / (2.0 * len(counts) - 4.0) - within * np.mean(1.0 / counts)
    return float(np.sqrt(max(between, 0.0))), float(px_per_mm * np.sqrt(within))


def _covariance(
    camera: CameraModel,
    poses: np.ndarray,
    views: _Views,
    variance: np.ndarray,
    print_sd: float,
    noise_sd: float,
) -> np.ndarray:
    """Covariance of all parameters from independent noise and from print errors that every posture repeats."""
    jacobians = _jacobians(camera, poses, views)
    normal = _normal_matrix(jacobians, variance, views.k2_sd)
    inverse = covariance_of(normal)
    noise = _normal_matrix(jacobians, variance**2 / noise_sd**2, views.k2_sd)
    spots = len(views.nominal)
    by_print = np.zeros((len(normal), 2 * spots))  # what a unit print error adds to the gradient
    for k, (block, place) in enumerate(zip(jacobians, _by_place(camera, poses, views), strict=True)):
        gain = np.einsum("nai,nab,n->inb", block, place, 1.0 / variance[k], optimize=True)
        by_print[_columns(k)] += gain.reshape(len(gain), -1)
    x, y = views.nominal.T
    rigid = np.stack([np.tile([1.0, 0.0], spots), np.tile([0.0, 1.0], spots), np.stack([-y, x], axis=-1).ravel()])
    rigid /= np.linalg.norm(rigid, axis=1, keepdims=True)  # orthogonal, the nominal grid being centred
    by_print -= by_print @ rigid.T @ rigid
    return inverse @ (noise + print_sd**2 * by_print @ by_print.T) @ inverse
