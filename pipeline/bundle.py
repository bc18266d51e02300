"""One bundle of everything: camera, projector, spots, postures and blank planes from all observations at once.

The scale comes from the board's printed pitch, heights from the rigidity of the tilted board, the projector from the
phases at its spots; the stage's readings are a start and no observation. The world is the board's frame in the flat
posture: origin and axes by the nominal spots best-fitted to the estimated ones, z = 0 the best plane through them.

Between postures the projected picture drifts against the camera, as far as the rig file says. Every posture has a
phase offset for it, held together by the random walk that a drift is. A camera that sees a board shrink by a few parts
per million would otherwise pull heights by the drift, which looks the same.

Where a board is tilted and out of focus, blur moves the phases at its spots along the slope (`slope_blur`), which looks
like another scale of z: nothing in the data would show it, so phases must come freed from it.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from greenough.instrument.contract import SpotBoard

from .blas import on_one_thread
from .bundle_data import BundleData
from .bundle_rows import BLOCKS, CENTRES, SPOT_PHASES, Rows, plane_rows, posture_rows
from .bundle_state import BoardShape, BundleState, Layout
from .camera_calibration import CameraCalibration
from .covariance import covariance_of
from .imaging_path import ImagingPath
from .instrument_model import InstrumentModel
from .legendre_field import DepthField
from .projector_model import ProjectorModel, fit_row, projector_picture

# Degrees of the residual fields, fixed and with depth. The camera's pose moves its picture and leans its rays.
_CAMERA_DEGREES = (1, 5), (1, 5)
_PROJECTOR_DEGREES = (0, 6), (0, 5)

# Weak priors about zero. For the fields: standard deviation of a coefficient of total degree n is this over n + 1.
_CAMERA_SD_PX = 0.2, 0.1
_PROJECTOR_SD_RAD = 3.0, 0.3
_SHAPE_SD_MM = 0.02
_LEAST_PRINT_SD_MM = 1e-4
_FRAME_SD_MM = 1e-7  # holds the print where the frame has it
_LEAST_OFFSET_SD_RAD = 1e-6  # of a path that does not drift

_START_SD = np.array([0.02, 0.003, 0.001])  # of centres (px), spots' phases and blocks (rad), until the residuals tell
_LEAST_SD = np.array([1e-3, 1e-4, 5e-5])  # some 10 nm: where pictures are perfect, the model is not
_OUTLIER = 5.0  # standard deviations
_LEAST_SHARE = 0.02  # of an observation's variance that its residual has
_ROUNDS = 6  # of solving, then weighting anew, unless the outliers stay the same
_ITERATIONS = 30
_CONVERGED = 1e-4  # squared length of a step in standard deviations


@dataclass(frozen=True, eq=False)
class Bundle:
    """The solution.

    Parameters
    ----------
    state : BundleState
        With the instrument's covariance: everything that the observations leave open, and of the board's scale what
        print errors that are independent of each other do to it. What the certificate leaves open is not in it.
    board : BoardShape
    residuals_px : (postures, spots, 2)
        Measured minus fitted centres; NaN where unseen or left out.
    residuals_rad : (postures, spots)
        The same of the phases at the spots.
    plane_residuals_rad : tuple of (blocks,) arrays
        The same of each plane's blocks.
    noise : (3,)
        Standard deviations that centres (px), phases at spots (rad) and block averages (rad) show; NaN where there are
        none.
    outliers : (3,) int
        How many of each were left out.
    """

    state: BundleState
    board: BoardShape
    residuals_px: np.ndarray
    residuals_rad: np.ndarray
    plane_residuals_rad: tuple[np.ndarray, ...]
    noise: np.ndarray
    outliers: np.ndarray

    def plane_height(self, plane: int, xy: np.ndarray) -> np.ndarray:
        """Height (n,) of a blank plane at (n, 2) x, y in the world."""
        return self.state.plane_height(plane, self.board, xy)


@on_one_thread
def solve_bundle(
    data: BundleData,
    start: CameraCalibration,
    board: SpotBoard,
    heights_mm: np.ndarray,
    path_drift_mm2: np.ndarray,
) -> Bundle:
    """Fit everything to everything by Gauss-Newton with damping.

    Each observation is weighted by its own variance plus one that is common to its kind and comes from the residuals.
    Observations more than five standard deviations off are left out. Without planes, the postures tell all; the shape
    of the blank face then stays at zero, where its prior has it.

    Parameters
    ----------
    data : BundleData
    start : CameraCalibration
        Of the same postures; its reference posture is the flat one.
    board : SpotBoard
    heights_mm : (planes,)
        Where to start the planes: the stage's readings.
    path_drift_mm2 : (postures, postures)
        Covariance of how far the projected picture had drifted on the specimen in each posture, along its columns.

    Raises
    ------
    InputError
        If there are too few phases at spots.
    """
    shape = BoardShape.of(board)
    state = _start(data, start, shape, np.asarray(heights_mm, dtype=float))
    problem = _Problem.of(data, state, shape, start, path_drift_mm2)
    weights = _start_weights(data)
    for _ in range(_ROUNDS):
        state, information = _solve(problem, state, weights)
        before, weights = weights, _reweighted(problem, state, weights, information)
        if all(np.array_equal(*kept) for kept in zip(before.kept, weights.kept, strict=True)):
            break
    state, information = _solve(problem, state, weights)
    instrument = problem.layout.instrument
    covariance = covariance_of(information)[:instrument, :instrument]
    state = replace(state, instrument=replace(state.instrument, covariance=covariance))
    return _result(problem, state, weights)


@dataclass(frozen=True, eq=False)
class _Problem:
    """Observations, the order of the unknowns, and what is known of them beforehand."""

    data: BundleData
    board: BoardShape
    layout: Layout
    prior_sd: np.ndarray  # (size,) about zero, infinite where nothing is assumed
    offset_information: np.ndarray  # (postures, postures) of the offsets about zero, 1/rad²

    @classmethod
    def of(
        cls,
        data: BundleData,
        state: BundleState,
        board: BoardShape,
        start: CameraCalibration,
        path_drift_mm2: np.ndarray,
    ) -> "_Problem":
        layout = Layout(
            instrument=state.instrument.parameters,
            spots=len(board.nominal),
            postures=len(data.spots),
            planes=len(data.planes),
            reference=start.reference,
        )
        sd = np.full(layout.size, np.inf)
        camera, projector = state.instrument.camera, state.instrument.projector
        sd[6 : camera.parameters] = np.tile(_field_sd(camera.field, *_CAMERA_SD_PX), 2)
        sd[camera.parameters : layout.instrument] = _field_sd(projector.field, *_PROJECTOR_SD_RAD)
        sd[layout.print] = max(start.print_sd_mm, _LEAST_PRINT_SD_MM)
        sd[layout.bow] = sd[layout.shape] = _SHAPE_SD_MM
        drift = projector.density**2 * path_drift_mm2 + _LEAST_OFFSET_SD_RAD**2 * np.eye(layout.postures)
        return cls(data, board, layout, sd, np.linalg.inv(drift))

    def rows(self, state: BundleState) -> list[Rows]:
        """Posture by posture, then plane by plane."""
        common = (state, self.layout, self.board, self.data)
        postures = [posture_rows(*common, k) for k in range(self.layout.postures)]
        return postures + [plane_rows(*common, k) for k in range(self.layout.planes)]

    def known(self, state: BundleState) -> np.ndarray:
        """Values (size,) of the unknowns that the prior speaks of, zero elsewhere."""
        values = np.zeros(self.layout.size)
        camera, projector = state.instrument.camera, state.instrument.projector
        values[6 : camera.parameters] = camera.coefficients.ravel()
        values[camera.parameters : self.layout.instrument] = projector.coefficients
        values[self.layout.print] = state.print_mm.ravel()
        values[self.layout.bow], values[self.layout.shape] = state.bow_mm, state.shape_mm
        return values


@dataclass(frozen=True, eq=False)
class _Weights:
    """Of every observation, in the order of `_Problem.rows`."""

    variance: list[np.ndarray]
    kept: list[np.ndarray]
    noise: np.ndarray  # (3,)


def _field_sd(field: DepthField, fixed: float, with_depth: float) -> np.ndarray:
    return np.where(field.with_depth, with_depth, fixed) / (1 + field.orders.sum(axis=1))


def _start(data: BundleData, start: CameraCalibration, board: BoardShape, heights_mm: np.ndarray) -> BundleState:
    """The paper's camera and poses, the row that fits the spots' phases, flat planes at given heights, no fields."""
    world_from_board = np.linalg.inv(start.camera_from_world) @ start.camera_from_board
    world_from_board[start.reference] = np.eye(4)
    on_board = np.column_stack([board.nominal, np.zeros(len(board.nominal))])
    spots = on_board @ world_from_board[:, :3, :3].swapaxes(1, 2) + world_from_board[:, None, :3, 3]
    seen = np.array([found.seen for found in data.spots])
    phases = np.where(seen, [measured.phase_rad for measured in data.phases], np.nan)
    row = fit_row(spots[np.isfinite(phases)], phases[np.isfinite(phases)])

    pixels = [plane.pixels for plane in data.planes]
    pixels = np.concatenate([*pixels, np.array([found.centres_px for found in data.spots])[seen]])
    z = np.concatenate(
        [*(np.full(len(p.pixels), h) for p, h in zip(data.planes, heights_mm, strict=True)), spots[seen][:, 2]]
    )
    depth = float(np.abs(z).max())
    field = DepthField.around(start.camera.normalised(pixels), *_CAMERA_DEGREES, depth)
    camera = ImagingPath(start.camera, start.camera_from_world, field, np.zeros((2, len(field.orders))))
    projector = ProjectorModel(row, field, np.zeros(len(field.orders)))
    points = InstrumentModel(camera, projector, np.empty(0)).points(pixels, z)
    field = DepthField.around(projector_picture(row, points), *_PROJECTOR_DEGREES, depth)
    projector = ProjectorModel(row, field, np.zeros(len(field.orders)))
    return BundleState(
        instrument=InstrumentModel(camera, projector, np.empty(0)),
        print_mm=np.zeros_like(board.nominal),
        bow_mm=np.zeros(3),
        world_from_board=world_from_board,
        planes=np.column_stack([heights_mm, np.zeros((len(heights_mm), 2))]),
        shape_mm=np.zeros(3),
        offsets_rad=np.zeros(len(data.spots)),
    )


def _own_variance(data: BundleData) -> list[np.ndarray]:
    """What each observation says of its own variance; infinite where nothing was measured."""
    own = []
    for found, measured in zip(data.spots, data.phases, strict=True):
        rad = np.where(found.seen, measured.sigma_rad, np.nan)
        own.append(np.nan_to_num(np.column_stack([found.sigma_px, found.sigma_px, rad]) ** 2, nan=np.inf).ravel())
    return own + [np.zeros(len(plane.phase_rad)) for plane in data.planes]


def _kinds(data: BundleData) -> list[np.ndarray]:
    spots = np.tile([CENTRES, CENTRES, SPOT_PHASES], len(data.spots[0].seen))
    return [spots] * len(data.spots) + [np.full(len(plane.phase_rad), BLOCKS) for plane in data.planes]


def _start_weights(data: BundleData) -> _Weights:
    own = _own_variance(data)
    variance = [each + _START_SD[kind] ** 2 for each, kind in zip(own, _kinds(data), strict=True)]
    return _Weights(variance, [np.isfinite(each) for each in own], _START_SD)


def _evaluate(problem: _Problem, state: BundleState, weights: _Weights) -> tuple[float, np.ndarray, np.ndarray]:
    """Cost, information matrix and gradient of all observations and of what is known beforehand."""
    size = problem.layout.size
    matrix, gradient, cost = np.zeros((size, size)), np.zeros(size), 0.0
    for rows, variance, kept in zip(problem.rows(state), weights.variance, weights.kept, strict=True):
        weight = 1.0 / np.sqrt(variance[kept])
        jacobian, residual = rows.jacobian[kept] * weight[:, None], rows.residual[kept] * weight
        matrix[np.ix_(rows.columns, rows.columns)] += jacobian.T @ jacobian
        gradient[rows.columns] += jacobian.T @ residual
        cost += residual @ residual
    known = problem.known(state) / problem.prior_sd
    matrix[np.diag_indices(size)] += problem.prior_sd**-2
    gradient -= known / problem.prior_sd
    frame, printed = problem.board.rigid_motions / _FRAME_SD_MM, problem.layout.print
    moved = frame @ state.print_mm.ravel()
    matrix[printed, printed] += frame.T @ frame
    gradient[printed] -= frame.T @ moved
    offsets, held = problem.layout.offsets, problem.offset_information @ state.offsets_rad
    matrix[offsets, offsets] += problem.offset_information
    gradient[offsets] -= held
    return float(cost + known @ known + moved @ moved + state.offsets_rad @ held), matrix, gradient


def _solve(problem: _Problem, state: BundleState, weights: _Weights) -> tuple[BundleState, np.ndarray]:
    """Levenberg-Marquardt until a step is far below the unknowns' standard deviations; state and information."""
    damping = 1e-4
    cost, matrix, gradient = _evaluate(problem, state, weights)
    for _ in range(_ITERATIONS):
        scale = np.sqrt(np.diag(matrix))
        damped = matrix / np.outer(scale, scale) + damping * np.eye(len(scale))
        step = cho_solve(cho_factor(damped), gradient / scale) / scale
        if step @ matrix @ step < _CONVERGED:
            break
        trial = problem.layout.moved(state, step)
        then = _evaluate(problem, trial, weights)
        if then[0] <= cost:
            state, damping = trial, 0.1 * damping
            cost, matrix, gradient = then
        elif damping > 1e3:
            break  # at the rounding of the cost
        else:
            damping *= 10.0
    return state, matrix


def _reweighted(problem: _Problem, state: BundleState, weights: _Weights, information: np.ndarray) -> _Weights:
    """Leave out outliers, and estimate the variance common to each kind from what the fit leaves over.

    A residual's variance is less than its observation's by what the fit took over of it, its leverage.
    """
    covariance = covariance_of(information)
    own, kinds = _own_variance(problem.data), _kinds(problem.data)
    kept, residuals, shares = [], [], []
    for rows, variance, alone in zip(problem.rows(state), weights.variance, own, strict=True):
        used = covariance[np.ix_(rows.columns, rows.columns)]
        leverage = np.sum((rows.jacobian @ used) * rows.jacobian, axis=1) / variance
        kept.append(np.isfinite(alone))
        residuals.append(rows.residual)
        shares.append(np.clip(1.0 - leverage, _LEAST_SHARE, 1.0))
    noise = np.full(3, np.nan)
    for kind in (CENTRES, SPOT_PHASES, BLOCKS) if problem.data.planes else (CENTRES, SPOT_PHASES):
        chosen = [used & (which == kind) for used, which in zip(kept, kinds, strict=True)]
        normalised = [r / np.sqrt(v * s) for r, v, s in zip(residuals, weights.variance, shares, strict=True)]
        least = _LEAST_SD[kind] / np.sqrt(np.median(_picked(weights.variance, chosen)))
        typical = max(np.median(np.abs(_picked(normalised, chosen))) / 0.6745, least)
        for used, here, values in zip(kept, chosen, normalised, strict=True):
            used[here] = np.abs(values[here]) < _OUTLIER * typical
        chosen = [used & here for used, here in zip(kept, chosen, strict=True)]
        excess = np.mean(_picked(residuals, chosen) ** 2 / _picked(shares, chosen)) - np.mean(_picked(own, chosen))
        noise[kind] = np.sqrt(max(excess, _LEAST_SD[kind] ** 2))
    for used in kept[: problem.layout.postures]:
        u, v, phase = used.reshape(-1, 3).T
        used[:] = np.column_stack([u & v, u & v, u & v & phase]).ravel()  # a wrong centre has a wrong phase
    variance = [alone + noise[kind] ** 2 for alone, kind in zip(own, kinds, strict=True)]
    return _Weights(variance, kept, noise)


def _picked(parts: list[np.ndarray], chosen: list[np.ndarray]) -> np.ndarray:
    return np.concatenate([part[here] for part, here in zip(parts, chosen, strict=True)])


def _result(problem: _Problem, state: BundleState, weights: _Weights) -> Bundle:
    residuals = [
        np.where(kept, rows.residual, np.nan) for rows, kept in zip(problem.rows(state), weights.kept, strict=True)
    ]
    own, kinds = _own_variance(problem.data), _kinds(problem.data)
    lost = [np.isfinite(alone) & ~kept for alone, kept in zip(own, weights.kept, strict=True)]
    postures = np.reshape(residuals[: problem.layout.postures], (problem.layout.postures, -1, 3))
    return Bundle(
        state=state,
        board=problem.board,
        residuals_px=postures[..., :2],
        residuals_rad=postures[..., 2],
        plane_residuals_rad=tuple(residuals[problem.layout.postures :]),
        noise=weights.noise,
        outliers=np.bincount(_picked(kinds, lost), minlength=3),
    )
