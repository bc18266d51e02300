"""What stage, board and table as they are must do to measured heights: a prediction without any frame.

The paper's method takes the stage's readings for heights of an ideal plane. Whatever the blank side really does
instead, its own shape and the table's drift included, goes into the relation that is fitted to 30 planes, and comes
back with the opposite sign. The bundle believes the board: its mean pitch is left, and the drift of the table until the
flat posture, which defines the frame. Nothing is said of errors that either method makes in fitting.
"""

from dataclasses import dataclass

import numpy as np
from numpy.polynomial import chebyshev
from scipy.special import ndtri

from ..bench import Bench
from ..instability import Instability
from .setup import Setup

DEGREE = 3  # a pixel's relation has four effective parameters
HALF_FIELD_MM = (3.7, 2.9)
_QUANTILES = 199  # deviates that stand for a normal distribution: its 95 % point to 3 %, its 99 % point to 9 %
_DRAWS = 100  # of what is left to chance: a standard deviation of them is known to 7 %


def field_grid() -> np.ndarray:
    """Places (n, 2) that stand for the field, mm."""
    x, y = np.meshgrid(*(np.linspace(-half, half, 13) for half in HALF_FIELD_MM))
    return np.column_stack([x.ravel(), y.ravel()])


@dataclass(frozen=True)
class Drift:
    """How far up the table had drifted in a calibration, mm: ``planes`` are (planes,)."""

    at_flat_posture: float
    at_zero: float
    planes: np.ndarray


def expected_error(
    setup: Setup, heights: np.ndarray, places: np.ndarray | None = None, z_range: np.ndarray | None = None
) -> np.ndarray:
    """Error of z that stage, board and table make by the setup's method at true heights; see `systematic_error`.

    ``z_range`` (places, 2) are the lowest and highest plane that were seen from each place, by default all: at the rim
    of the board and of the light they are fewer.

    The bundle takes the mean pitch of its board for the drawing's: what that is too long by, all lengths become too
    short by.
    """
    drift = calibration_drift(setup)
    if setup.believes_stage:
        seen = None
        if z_range is not None:
            half_step = setup.calibration.procedure.plane_step_mm / 2
            readings = setup.readings[:, None]
            seen = (readings > z_range[:, 0] - half_step) & (readings < z_range[:, 1] + half_step)
        return systematic_error(setup.bench, setup.readings, heights, places, drift, seen)
    printed, drawn = setup.bench.printed_centres, setup.calibration.board.centres()
    excess = np.sum((printed - drawn) * drawn) / np.sum(drawn**2)  # both are centred
    heights = _at_places(heights, field_grid() if places is None else places)
    return -excess * heights - drift.at_flat_posture


def systematic_error(
    bench: Bench,
    readings: np.ndarray,
    heights: np.ndarray,
    places: np.ndarray | None = None,
    drift: Drift | None = None,
    seen: np.ndarray | None = None,
) -> np.ndarray:
    """Error of z by the paper's method at true heights.

    They are counted from what the relations make of the blank side at stage position 0: from the mean over the field,
    whichever places are asked for.

    Parameters
    ----------
    bench : Bench
    readings : (planes,)
        Stage positions of the calibration's planes, mm.
    heights : (h,) or (h, places)
        The same at all places, or of each.
    places : (places, 2), optional
        mm; default is ``field_grid()``.
    drift : Drift, optional
        None if there is none to be reckoned with.
    seen : (planes, places) bool, optional
        Which planes each place's relation is fitted to; default is all.

    Returns
    -------
    (h, places) mm
    """
    field = field_grid()
    places = field if places is None else places
    heights = _at_places(heights, places)
    scale = np.abs(readings).max()
    lag, lag_at_zero = (np.zeros(len(readings)), 0.0) if drift is None else (drift.planes, drift.at_zero)

    def blank_faces(xy: np.ndarray) -> np.ndarray:  # (planes, places)
        return np.stack([bench.blank_face_height(reading, xy) for reading in readings]) + lag[:, None]

    true = blank_faces(places)
    at_zero = bench.blank_face_height(0.0, field) + lag_at_zero
    relations = (chebyshev.chebfit(heights_there / scale, readings, DEGREE) for heights_there in blank_faces(field).T)
    zero = np.mean([chebyshev.chebval(z / scale, relation) for z, relation in zip(at_zero, relations, strict=True)])
    error = np.empty(heights.shape)
    for k in range(len(places)):
        used = slice(None) if seen is None else seen[:, k]
        relation = chebyshev.chebfit(true[used, k] / scale, readings[used], DEGREE)
        error[:, k] = chebyshev.chebval(heights[:, k] / scale, relation) - heights[:, k]
    return error - zero


def calibration_drift(setup: Setup) -> Drift:
    """Drift of the table in the calibration's run.

    Its planes are the last captures, after the flat posture; the few exposures to set the exposure in between are left
    out of the count.
    """
    procedure, settings = setup.calibration.procedure, setup.bench.settings
    frames = sum(procedure.steps)
    run = Instability(settings.stability, settings.seed, setup.calibration.run, procedure.exposures)
    first = setup.calibration.exposures - frames * np.arange(len(setup.readings) + 2, 0, -1)
    flat, zero, *planes = (float(run.table_drift(int(serial))[2]) for serial in np.maximum(first, 0))
    return Drift(flat, zero, np.array(planes))


def left_to_chance(setup: Setup, heights: np.ndarray, exposures: int) -> np.ndarray:
    """Draws of the error of z at true ``heights`` (h, places) that `expected_error` does not know.

    It is the drift of the projected picture against the camera, a random walk, which looks like one of the surface by
    1 / (2 sin α) as much, where 2α is the angle between the paths. While the planes were taken it went into the
    relation. The height that is measured is of another run, whose drift begins anew; heights after different
    ``exposures`` lie on one walk.

    Parameters
    ----------
    setup : Setup
    heights : (h, places)
        mm.
    exposures : int
        Of the run in which the heights are measured, before them.

    Returns
    -------
    (draws, h, places) mm
    """
    settings = setup.bench.settings
    sd = 1e-3 * settings.stability.path_drift_um / (2 * np.sin(np.radians(settings.optics.convergence_deg / 2)))
    own_rng, rng = (np.random.default_rng(key) for key in (1, 0))
    planes, procedure = len(setup.readings), setup.calibration.procedure
    captures = procedure.postures + planes
    # Rows are drawn one after the other: a longer walk goes on as the shorter one began.
    walked = own_rng.standard_normal((round(exposures / sum(procedure.steps)), _DRAWS)).sum(axis=0)
    own = (sd / np.sqrt(captures) * walked)[:, None, None]
    if not setup.believes_stage:
        return np.broadcast_to(own, (_DRAWS, *heights.shape))
    walk = sd / np.sqrt(captures) * rng.standard_normal((_DRAWS, planes + 1)).cumsum(axis=1)
    scale = np.abs(setup.readings).max()

    def powers(z: np.ndarray) -> np.ndarray:
        return chebyshev.chebvander(z / scale, DEGREE)

    relations = walk[:, 1:] @ np.linalg.pinv(powers(setup.readings)).T  # (draws, coefficients)
    fitted = np.einsum("hpc,dc->dhp", powers(heights), relations)
    zero = walk[:, 0] - relations @ powers(np.zeros(1))[0]
    return own - fitted - zero[:, None, None]


def calibration_noise_share(setup: Setup, heights: np.ndarray) -> float:
    """Noise that the calibration's planes leave in z at ``heights`` (n,), over that of one measurement: RMS over these.

    The polynomial V c through the planes, which are as noisy, has at z the variance v(z)ᵀ (VᵀV)⁻¹ v(z) of one of them.
    It is a pattern of single pixels that no filter takes out of z. The bundle fits no relation to single pixels and has
    no such pattern.
    """
    if not setup.believes_stage or heights.size == 0:
        return 0.0
    scale = np.abs(setup.readings).max()
    planes, here = (chebyshev.chebvander(z / scale, DEGREE) for z in (setup.readings, heights))
    leverage = np.einsum("ni,ij,nj->n", here, np.linalg.inv(planes.T @ planes), here)
    return float(np.sqrt(leverage.mean()))


def calibration_noise(setup: Setup) -> float | None:
    """Noise of single pixels in the calibration's planes, mm RMS, from the residuals that it states; None without any.

    What the planes of a pixel leave beside its relation, less what a whole block of pixels has in common, which is the
    stage's. As many degrees of freedom are lost as a relation has parameters.
    """
    residuals = setup.calibration.residuals
    if residuals is None:
        return None
    planes = len(setup.readings)
    scatter, common = (np.nanmean(np.square(um, dtype=float)) for um in (residuals.pixels_um, residuals.planes_um))
    return 1e-3 * float(np.sqrt(max(scatter - common, 0.0) * planes / (planes - DEGREE - 1)))


def percentile_with_noise(error: np.ndarray, sigma: float, share: float) -> float:
    """The ``share``-quantile of |error + noise| over all errors, for normal noise of ``sigma``, mm. NaN of none."""
    if error.size == 0:
        return np.nan
    noise = sigma * ndtri((np.arange(_QUANTILES) + 0.5) / _QUANTILES)
    return float(np.quantile(np.abs(error.ravel()[:, None] + noise), share))


def _at_places(heights: np.ndarray, places: np.ndarray) -> np.ndarray:
    """(h, places) from (h,) or (h, places)."""
    return np.broadcast_to(heights if heights.ndim == 2 else heights[:, None], (len(heights), len(places)))
