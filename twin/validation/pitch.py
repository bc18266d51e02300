"""Claims about distances: neighbouring spots of the board that set the scale, and of one that did not."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from greenough.instrument.contract import Placement, SpotBoard
from greenough.pipeline.decode import PhaseMap
from greenough.pipeline.spot_points import REACH, spot_points
from greenough.pipeline.spots import Spots, detect_spots

from .claims import Claim
from .planes import mean, rms
from .setup import Setup

SECOND = "pitch_second_board"
POSTURE = 1000
"""A posture that no calibration has seen."""

PAPER_ROWS, PAPER_COLS = 5, 7
"""The paper measures 35 spots: 30 pairs along the rows and 28 along the columns."""

ERROR_MEAN_LIMIT_UM, ERROR_SD_LIMIT_UM = 0.1, 0.3
"""Of distances on a board that the calibration has not seen, against the distances that were printed."""

FILTER = "phase averaged over each spot"


@dataclass(frozen=True, eq=False)
class MeasuredBoard:
    """A board in a new posture, as every calibration sees it.

    Parameters
    ----------
    part, prefix : str
        The board, and how the names of its rows begin.
    background : (rows, cols) float
        Its picture, DN above black.
    spots : Spots
    points : sequence of (spots, 3) float64
        Spots' centres by every calibration, mm; NaN where unseen.
    noise : sequence of float
        What the frames' noise gives to a distance by every calibration: a standard deviation in mm.
    """

    part: str
    prefix: str
    background: np.ndarray
    spots: Spots
    points: Sequence[np.ndarray]
    noise: Sequence[float]


def measure_boards(setups: Sequence[Setup]) -> Iterator[MeasuredBoard]:
    """Hold one board after the other in a new posture, and evaluate it by every calibration.

    The board that came last is still mounted when it is yielded.
    """
    # A calibration that estimates the spots leaves their centres' scatter; one that does not, the board's print errors.
    centre_px = min(rms(np.array([s.calibration.figures[f"reprojection_rmse_{a}_px"] for a in "uv"])) for s in setups)
    for part, prefix in (("board", "pitch"), ("second-board", SECOND)):
        setups[0].place(Placement(part, posture=POSTURE))
        phase_map = setups[0].capture()
        spots = detect_spots(phase_map.background, setups[0].calibration.board)
        points = [spot_points(phase_map, spots, setup.calibration) for setup in setups]
        noise = [distance_noise(setup, phase_map, spots, centre_px) for setup in setups]
        yield MeasuredBoard(part, prefix, phase_map.background, spots, points, noise)


def pitch_claims(setups: Sequence[Setup], board: MeasuredBoard) -> Iterator[Claim]:
    """Distances on the mounted board by every calibration."""
    for setup, points, noise in zip(setups, board.points, board.noise, strict=True):
        yield from board_claims(setup, board.part, board.prefix, points, noise)


def second_board_errors(setups: Sequence[Setup]) -> list[np.ndarray]:
    """Errors (pairs,) mm of all neighbours' distances on the second board in a new posture, by every calibration.

    Raises BoardNotFound, an InputError, where its spots are not found.
    """
    setups[0].place(Placement("second-board", posture=POSTURE))
    phase_map = setups[0].capture()
    spots = detect_spots(phase_map.background, setups[0].calibration.board)
    printed, pairs = setups[0].bench.specimen.as_built["centres_mm"], all_pairs(setups[0].calibration.board)
    found = (spot_points(phase_map, spots, setup.calibration) for setup in setups)
    return [distance_errors(centres, printed, pairs) for centres in found]


def distance_errors(measured: np.ndarray, printed: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """How much too long the distances of ``pairs`` (pairs, 2) of points (n, 3) are, without those of unseen points."""
    errors = _distances(measured, pairs) - _distances(printed, pairs)
    return errors[np.isfinite(errors)]


def board_claims(setup: Setup, part: str, prefix: str, centres: np.ndarray, noise: float) -> Iterator[Claim]:
    """Distances of neighbours on one board, whose spots were measured at ``centres`` (spots, 3) mm.

    ``noise`` is the standard deviation in mm that the frames' noise gives to a distance.

    On the second board, and by the bundle, they are held to what was printed there.
    """
    true = setup.bench.specimen.as_built["centres_mm"]
    board = setup.calibration.board
    judged = prefix == SECOND and not setup.believes_stage
    mean_limit, sd_limit = (ERROR_MEAN_LIMIT_UM, ERROR_SD_LIMIT_UM) if judged else (None, None)
    for pairs, suffix in ((paper_pairs(board), ""), (all_pairs(board), "_all_spots")):
        distances = _distances(centres, pairs)
        seen = np.isfinite(distances)
        measured, printed, n = distances[seen], _distances(true, pairs)[seen], int(seen.sum())
        error = measured - printed
        yield setup.claim(
            f"{prefix}_mean{suffix}", part, mean(measured), "mm", n,
            f"within 0.0015 mm of {board.pitch_mm:g} mm", paper=0.6502, limit=0.0015,
            holds=abs(mean(measured) - board.pitch_mm) <= 0.0015, filter=FILTER,
            predicted=mean(printed),
        )  # fmt: skip
        yield setup.claim(
            f"{prefix}_sd{suffix}", part, sample_sd(measured), "mm", n,
            "standard deviation of single distances, the board's print errors included; predicted from these",
            paper=0.0011, limit=0.0011, filter=FILTER, predicted=sample_sd(printed),
            # Errors of sd e that are independent of the print's change its standard deviation by e / sqrt(n). The
            # calibration's own errors, which are smooth over the field, are left out.
            predicted_sd=noise / np.sqrt(max(n, 1)),
        )  # fmt: skip
        yield setup.claim(
            f"{prefix}_error_mean{suffix}", part, 1e3 * mean(error), "um", n,
            "mean difference from the true distances of this board", filter=FILTER, limit=mean_limit,
        )  # fmt: skip
        yield setup.claim(
            f"{prefix}_error_sd{suffix}", part, 1e3 * sample_sd(error), "um", n,
            "standard deviation of the differences from the true distances of this board", filter=FILTER,
            limit=sd_limit,
        )  # fmt: skip


def distance_noise(setup: Setup, phase_map: PhaseMap, spots: Spots, centre_px: float) -> float:
    """Standard deviation in mm that the frames' noise gives to the distance of two spots, at most.

    √2 times that of one spot: of its centre in the picture, ``centre_px``, and of the plane through the heights within
    it, whose value in the middle has the noise of a mean. A distance along a tilted board contains a share of the
    heights' alone; the whole is reckoned with.
    """
    pixel = setup.bench.settings.optics.pupil_distance_mm / setup.calibration.camera.fx
    height = rms(setup.height_sigma(phase_map)[phase_map.valid])
    pixels_within = np.pi * (REACH * np.nanmedian(spots.axes_px)) ** 2
    return float(np.sqrt(2) * np.hypot(pixel * centre_px, height / np.sqrt(pixels_within)))


def all_pairs(board: SpotBoard) -> np.ndarray:
    """Indices (pairs, 2) of all neighbours along rows and columns."""
    index = np.arange(board.rows * board.cols).reshape(board.rows, board.cols)
    return _neighbours(index)


def paper_pairs(board: SpotBoard) -> np.ndarray:
    """Indices (58, 2) of the neighbours among the 35 spots in the middle of the board."""
    index = np.arange(board.rows * board.cols).reshape(board.rows, board.cols)
    top, left = (board.rows - PAPER_ROWS) // 2, (board.cols - PAPER_COLS) // 2
    return _neighbours(index[top : top + PAPER_ROWS, left : left + PAPER_COLS])


def sample_sd(values: np.ndarray) -> float:
    """Standard deviation of a sample; NaN of less than two."""
    return float(np.std(values, ddof=1)) if len(values) > 1 else np.nan


def _neighbours(index: np.ndarray) -> np.ndarray:
    along = np.stack([index[:, :-1].ravel(), index[:, 1:].ravel()], axis=-1)
    down = np.stack([index[:-1].ravel(), index[1:].ravel()], axis=-1)
    return np.concatenate([along, down])


def _distances(points: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    return np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=-1)
