"""Calibrates the projector as an inverse camera of one row beside the camera: plain stereo of two pinholes.

Vertical fringes show columns and no rows: of the projector's 3 x 4 matrix two rows are seen, whose quotient has seven
numbers. What Brown's radial and tangential terms do to a column, they do in the projector's picture and with its second
and third powers, at every depth alike: so the lens's distortion is a field of degrees 2 and 3 without depth.

In the nearly parallel light of a stereomicroscope a camera by itself hardly knows the distance of a board nor how far
it leans itself. So the camera's parameters and postures are refined together with the projector's, held by the
covariance that its own calibration left them: near its solution this is the adjustment of all spots and phases at once.
"""

from dataclasses import dataclass, replace

import numpy as np

from greenough.instrument.contract import SpotBoard

from .bundle_data import SpotPhases
from .camera_calibration import INTRINSICS, CameraCalibration
from .camera_model import CameraModel
from .covariance import covariance_root
from .imaging_path import ImagingPath, cross_matrices, moved_pose
from .instrument_model import InstrumentModel
from .legendre_field import DepthField
from .projector_model import ProjectorModel, fit_row, projector_picture
from .spots import Spots

_DISTORTION = 2, 3  # lowest and highest degree
# Fields that hold every small change of what is fitted, for the covariance: of Brown's camera, all polynomials up to
# k2's fifth degree; of the row, which moves with depth, second powers that grow with it.
_CAMERA_DEGREES = (0, 5), (0, -1)
_PROJECTOR_DEGREES = (0, 3), (0, 2)

_FIELD_SD_RAD = 3.0  # weak prior about zero of a coefficient of degree n, times n + 1: the row bends the picture, too
_START_SD_RAD = 0.01  # of the phases, until the residuals tell
_LEAST_SD_RAD = 1e-4
_OUTLIER = 5.0  # standard deviations
_ROUNDS = 8  # of a Gauss-Newton step, then weighting anew


@dataclass(frozen=True, eq=False)
class StereoCalibration:
    """A calibrated pair.

    Parameters
    ----------
    instrument : InstrumentModel
        Its covariance is that of everything that was fitted, the camera's intrinsic parameters included: linear, and
        conditional on the model. Of what a pinhole with distortion or a row lacks, it knows nothing.
    camera_from_board : (postures, 4, 4)
    spots_mm : (postures, spots, 3)
        Nominal places in the world.
    residuals_rad : (postures, spots)
        Measured minus fitted phases at the nominal places; NaN where none was measured or it was left out.
    outliers : int
        How many were left out: more than five standard deviations off.
    """

    instrument: InstrumentModel
    camera_from_board: np.ndarray
    spots_mm: np.ndarray
    residuals_rad: np.ndarray
    outliers: int


def calibrate_stereo(
    spots: tuple[Spots, ...], phases: tuple[SpotPhases, ...], start: CameraCalibration, board: SpotBoard
) -> StereoCalibration:
    """Fit the projector, and what is left open of the camera, to the phases at the spots by weighted least squares.

    Spots are at their nominal places. The phase was measured where the spot was found; with its gradient g it is taken
    to where the camera images the nominal place, Φ + g·(image - found). That frees it from the spot's print error, as
    what lies there is the board's face, whatever is printed on it.

    Each phase is weighted by its own variance plus one that is common to all and comes from the residuals.

    Raises
    ------
    InputError
        If the phases do not determine the projector.
    """
    pair, views = _start(spots, phases, start, board)
    measured = np.isfinite(views.phase)
    used, excess = measured, _START_SD_RAD**2
    for _ in range(_ROUNDS):
        step = _step(pair, views, used, excess)
        pair = pair.moved(step.step)
        views = _see(pair.camera, pair.poses, pair.reference, spots, phases, board)
        residual = views.phase - pair.projector.phase(views.xyz.reshape(-1, 3)).reshape(used.shape)
        normalised = np.where(measured, np.abs(residual) / np.sqrt(views.variance + excess), np.inf)
        typical = max(np.median(normalised[measured]) / 0.6745, _LEAST_SD_RAD / np.sqrt(excess))
        used = normalised < _OUTLIER * typical
        shown = np.sum(residual[used] ** 2) / (used.sum() - step.taken) - np.mean(views.variance[used])
        excess = max(shown, _LEAST_SD_RAD**2)
    step = _step(pair, views, used, excess)
    return StereoCalibration(
        instrument=_instrument(pair, step.covariance, views.xyz[used]),
        camera_from_board=pair.poses,
        spots_mm=views.xyz,
        residuals_rad=np.where(used, residual, np.nan),
        outliers=int(measured.sum() - used.sum()),
    )


@dataclass(frozen=True, eq=False)
class _Pair:
    """Both paths, and how far the camera is from where its own calibration left it, in units of ``root``."""

    camera: CameraModel
    poses: np.ndarray  # (postures, 4, 4)
    reference: int
    projector: ProjectorModel
    root: np.ndarray  # of the covariance of the camera's own calibration, parameters in its order
    away: np.ndarray

    @property
    def fitted(self) -> np.ndarray:
        """Which terms of the projector's field are fitted, (terms,) bool."""
        field = self.projector.field
        degree = field.orders.sum(axis=1)
        return ~field.with_depth & (degree >= _DISTORTION[0]) & (degree <= _DISTORTION[1])

    def moved(self, step: np.ndarray) -> "_Pair":
        """After a step of the row, of the fitted terms, and of the camera in units of ``root``."""
        row, terms, away = np.split(step, [7, 7 + self.fitted.sum()])
        coefficients = self.projector.coefficients.copy()
        coefficients[self.fitted] += terms
        change = self.root @ away
        intrinsics = {name: getattr(self.camera, name) + float(change[k]) for k, name in enumerate(INTRINSICS)}
        return replace(
            self,
            camera=replace(self.camera, **intrinsics),
            poses=np.stack([moved_pose(pose, change[_pose(k)]) for k, pose in enumerate(self.poses)]),
            projector=replace(self.projector, row=self.projector.row + row, coefficients=coefficients),
            away=self.away + away,
        )


@dataclass(frozen=True, eq=False)
class _Views:
    """Nominal spots where the camera places them, and the phases there.

    ``phase_by_camera`` is how far the camera's parameters move what is measured of the phase at the nominal place,
    ``place_by_camera`` how far they move that place in the world.
    """

    xyz: np.ndarray  # (postures, spots, 3)
    phase: np.ndarray  # (postures, spots), NaN where not measured
    variance: np.ndarray  # (postures, spots)
    phase_by_camera: np.ndarray  # (postures, spots, parameters)
    place_by_camera: np.ndarray  # (postures, spots, 3, parameters)


def _start(
    spots: tuple[Spots, ...], phases: tuple[SpotPhases, ...], start: CameraCalibration, board: SpotBoard
) -> tuple[_Pair, _Views]:
    """The camera as its own calibration left it, and the row that fits the phases without any distortion."""
    camera, poses = start.camera, start.camera_from_board
    views = _see(camera, poses, start.reference, spots, phases, board)
    measured = np.isfinite(views.phase)
    xyz = views.xyz[measured]
    row = fit_row(xyz, views.phase[measured])
    field = DepthField.around(projector_picture(row, xyz), *_PROJECTOR_DEGREES, float(np.abs(xyz[:, 2]).max()))
    projector, root = ProjectorModel(row, field, np.zeros(len(field.orders))), covariance_root(start.covariance)
    return _Pair(camera, poses, start.reference, projector, root, np.zeros(len(root))), views


def _see(
    camera: CameraModel,
    poses: np.ndarray,
    reference: int,
    spots: tuple[Spots, ...],
    phases: tuple[SpotPhases, ...],
    board: SpotBoard,
) -> _Views:
    parameters = len(INTRINSICS) + 6 * len(poses)
    nominal = np.column_stack([board.centres(), np.zeros(board.rows * board.cols)])
    camera_from_world = poses[reference]
    world_from_camera = camera_from_world[:3, :3].T
    one = np.broadcast_to(np.eye(3), (len(nominal), 3, 3))
    views = []
    for k, (found, measured) in enumerate(zip(spots, phases, strict=True)):
        turned = nominal @ poses[k, :3, :3].T
        in_camera = turned + poses[k, :3, 3]
        from_world = in_camera - camera_from_world[:3, 3]
        pixel, _, pixel_by_pose = _camera_path(camera, poses[k]).linearise(nominal)
        pixel_by_camera = np.zeros((len(nominal), 2, parameters))
        pixel_by_camera[..., : len(INTRINSICS)] = _by_intrinsics(camera, in_camera)
        pixel_by_camera[..., _pose(k)] = pixel_by_pose[..., :6]
        # A step of the pose moves the spot in the camera's frame, one of the reference's moves the world beneath it.
        by_pose = np.concatenate([-cross_matrices(turned), one], axis=-1)
        by_reference = np.concatenate([cross_matrices(from_world), -one], axis=-1)
        place_by_camera = np.zeros((len(nominal), 3, parameters))
        place_by_camera[..., _pose(k)] = world_from_camera @ by_pose
        place_by_camera[..., _pose(reference)] += world_from_camera @ by_reference
        views.append(
            (
                from_world @ world_from_camera.T,
                measured.phase_rad + np.sum(measured.gradient_rad * (pixel - found.centres_px), axis=1),
                measured.sigma_rad**2,
                np.einsum("nj,njp->np", measured.gradient_rad, pixel_by_camera),
                place_by_camera,
            )
        )
    return _Views(*(np.stack(parts) for parts in zip(*views, strict=True)))


@dataclass(frozen=True, eq=False)
class _Step:
    """A step of `_Pair.moved`, its covariance, and how many degrees of freedom it takes of the phases."""

    step: np.ndarray
    covariance: np.ndarray
    taken: float


def _step(pair: _Pair, views: _Views, used: np.ndarray, excess: float) -> _Step:
    """One step of Gauss-Newton, with what is known beforehand of the distortion and of the camera."""
    xyz = views.xyz[used]
    phase, by_point, _ = pair.projector.linearise(xyz)
    by_camera = np.einsum("nj,njp->np", by_point, views.place_by_camera[used]) - views.phase_by_camera[used]
    weight = 1.0 / np.sqrt(views.variance[used] + excess)
    observed = weight[:, None] * np.column_stack([_by_projector(pair, xyz), by_camera @ pair.root])
    field_sd = _FIELD_SD_RAD / (1 + pair.projector.field.orders[pair.fitted].sum(axis=1))
    prior_sd = np.concatenate([np.full(7, np.inf), field_sd, np.ones(len(pair.away))])
    known = np.concatenate([np.zeros(7), pair.projector.coefficients[pair.fitted], pair.away])
    design = np.vstack([observed, np.diag(1.0 / prior_sd)])
    missed = np.concatenate([weight * (views.phase[used] - phase), -known / prior_sd])
    lengths = np.linalg.norm(design, axis=0)
    left, sizes, right = np.linalg.svd(design / lengths, full_matrices=False)
    inverse = (right.T / sizes) / lengths[:, None]
    return _Step(inverse @ (left.T @ missed), inverse @ inverse.T, float(np.sum(left[: len(observed)] ** 2)))


def _by_projector(pair: _Pair, xyz: np.ndarray) -> np.ndarray:
    """Derivatives (n, 7 + fitted terms) of the modelled phase at points (n, 3)."""
    _, _, terms = pair.projector.linearise(xyz)
    return np.column_stack([pair.projector.by_row(xyz), terms[:, pair.fitted]])


def _instrument(pair: _Pair, covariance: np.ndarray, xyz: np.ndarray) -> InstrumentModel:
    """Both paths, and the covariance of what was fitted as that of fields that do the same at points (n, 3)."""
    path = _camera_path(pair.camera, pair.poses[pair.reference])
    in_camera = xyz @ path.camera_from_world[:3, :3].T + path.camera_from_world[:3, 3]
    terms = path.field.values(in_camera[:, :2] / in_camera[:, 2:], xyz[:, 2])
    by_intrinsics = _by_intrinsics(pair.camera, in_camera)
    as_camera = np.zeros((path.parameters, len(pair.root)))
    as_camera[:6, _pose(pair.reference)] = np.eye(6)
    as_camera[6:, : len(INTRINSICS)] = np.concatenate(
        [np.linalg.lstsq(terms, by_intrinsics[:, axis], rcond=None)[0] for axis in range(2)]
    )
    _, _, terms = pair.projector.linearise(xyz)
    as_projector = np.linalg.lstsq(terms, _by_projector(pair, xyz), rcond=None)[0]
    split, count = path.parameters, as_projector.shape[1]
    fields = np.zeros((split + len(as_projector), len(covariance)))
    fields[split:, :count], fields[:split, count:] = as_projector, as_camera @ pair.root
    return InstrumentModel(path, pair.projector, fields @ covariance @ fields.T)


def _camera_path(camera: CameraModel, camera_from_frame: np.ndarray) -> ImagingPath:
    """The camera as it is, with room in its field for changes of its intrinsic parameters all over the picture."""
    rows, cols = camera.shape
    corners = np.array([[0, 0], [cols - 1, 0], [0, rows - 1], [cols - 1, rows - 1]], dtype=float)
    field = DepthField.around(camera.normalised(corners), *_CAMERA_DEGREES, 1.0)
    return ImagingPath(camera, camera_from_frame, field, np.zeros((2, len(field.orders))))


def _by_intrinsics(camera: CameraModel, in_camera: np.ndarray) -> np.ndarray:
    """Derivatives (n, 2, 9) of pixels of points (n, 3) by the intrinsic parameters: pixels are linear in each."""
    normalised = in_camera[:, :2] / in_camera[:, 2:]
    pixels = camera.pixels(normalised)
    changed = (replace(camera, **{name: getattr(camera, name) + 1.0}) for name in INTRINSICS)
    return np.stack([other.pixels(normalised) - pixels for other in changed], axis=-1)


def _pose(posture: int) -> slice:
    """Where a posture's pose stands among the camera's parameters."""
    first = len(INTRINSICS) + 6 * posture
    return slice(first, first + 6)
