"""Which spot is which: puts blobs seen in a picture into the board's order, whatever posture the board lies in."""

import cv2
import numpy as np
from scipy.spatial import KDTree

from greenough.instrument.contract import SpotBoard
from greenough.instrument.errors import InputError

MIN_SPOTS = 20  # fewer cannot tell an accidental pattern from the board
_CELL_TOLERANCE = 0.2  # of a pitch: distance of a spot from its lattice point
_AREA_FACTOR = 1.6  # an area may differ by this from the drawing's before the blob counts as no spot
_MAX_LOSS = 4  # of the score: two spots of the wrong size, or four blobs off the board
_MIN_MARGIN = 4  # to the next best order: two misread spots must not decide


class BoardNotFound(InputError):
    """The calibration board is not in the picture, or not enough of it; the sentence says how many spots were seen."""


def order_spots(centres_px: np.ndarray, areas_px: np.ndarray, board: SpotBoard) -> np.ndarray:
    """Assign blobs to the board's spots.

    A lattice is grown from the densest neighbourhood by a homography that is refitted as it spreads; each blob is
    called big or small by its area against the lattice cell's, as the drawing has it. The board's order is the one of
    the four rotations and all shifts that agrees best with the pattern of big spots; the board is seen from its
    printed side, so mirror images are excluded. Without big spots the grid must have all its rows and columns, and of
    the rotations that fit it is the one in which columns run most to the right.

    Parameters
    ----------
    centres_px : (n, 2)
        (u, v) of blobs, in any order, foreign ones among them.
    areas_px : (n,)
        Their areas.

    Returns
    -------
    (rows * cols,) int
        Index of the blob that is the spot, in the board's order; -1 where unseen.

    Raises
    ------
    BoardNotFound
        Fewer than 20 spots form a lattice, or what is seen fits the board in more than one way.
    """
    total = board.rows * board.cols
    if len(centres_px) < MIN_SPOTS:
        raise BoardNotFound(_too_few(len(centres_px), total))
    labels, member, cell_areas = _grow_lattice(centres_px)
    drawn = np.pi / 4 * np.array([board.small_diameter_mm, board.big_diameter_mm]) ** 2 / board.pitch_mm**2
    with np.errstate(divide="ignore", invalid="ignore"):
        log_ratio = np.log(areas_px[:, None] / cell_areas[:, None] / drawn)  # (n, 2): against small, against big
    is_big = np.abs(log_ratio[:, 1]) < np.abs(log_ratio[:, 0])
    member &= np.min(np.abs(log_ratio), axis=1) < np.log(_AREA_FACTOR)
    found = np.flatnonzero(member)
    if len(found) < MIN_SPOTS:
        raise BoardNotFound(_too_few(len(found), total))
    if board.big:
        row, col = _match_big_spots(labels[found], is_big[found], board)
    else:
        row, col = _match_whole_grid(labels[found], centres_px[found], board)
    inside = (row >= 0) & (row < board.rows) & (col >= 0) & (col < board.cols)
    index = np.full(total, -1)
    index[row[inside] * board.cols + col[inside]] = found[inside]
    return index


def _too_few(found: int, total: int) -> str:
    return (
        f"calibration board not found: {found} spots of a grid were seen, but at least {MIN_SPOTS} of its {total} are "
        "needed; lay the printed side up, inside the lit field, and expose it without saturation"
    )


def _grow_lattice(points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Integer lattice coordinates (n, 2), membership (n,) and area of the lattice cell in px² at each point (n,)."""
    column_step, row_step, seed = _lattice_basis(points)
    lattice = np.column_stack([np.append(column_step, 0), np.append(row_step, 0), np.append(points[seed], 1)])
    reach = 2.5
    spread = len(points)  # cells
    while True:
        cells = cv2.perspectiveTransform(points[:, None], np.linalg.inv(lattice))[:, 0]
        labels = np.rint(cells).astype(int)
        miss = np.hypot(*(cells - labels).T)
        member = (miss < _CELL_TOLERANCE) & (np.hypot(*labels.T) <= reach)
        member &= _closest_of_each(labels, miss)
        if member.sum() < 6 or np.linalg.matrix_rank(labels[member] - labels[member][0]) < 2:
            raise BoardNotFound("calibration board not found: the spots seen lie on no common grid")
        lattice = _fit_lattice(labels[member], points[member])
        if reach > spread:
            break
        reach *= 1.6
    denominator = labels @ lattice[2, :2] + lattice[2, 2]
    return labels, member, np.abs(np.linalg.det(lattice) / denominator**3)


def _lattice_basis(points: np.ndarray) -> tuple[np.ndarray, np.ndarray, int]:
    """Two shortest common steps between neighbours, right-handed in (u, v), and a point that has all four."""
    neighbours = min(9, len(points))
    near = np.asarray(KDTree(points).query(points, k=neighbours)[1])
    steps = (points[near[:, 1:]] - points[:, None]).reshape(-1, 2)
    scale = np.median(np.linalg.norm(points[near[:, 1]] - points, axis=1))
    tree = KDTree(steps)
    alike = tree.query_ball_point(steps, 0.15 * scale)
    counts = np.array([len(group) for group in alike])
    common = np.flatnonzero(counts >= 0.4 * counts.max())
    common = common[np.argsort(np.linalg.norm(steps[common], axis=1))]
    first = steps[alike[common[0]]].mean(axis=0)
    for candidate in common:
        second = steps[alike[candidate]].mean(axis=0)
        turn = first[0] * second[1] - first[1] * second[0]
        if abs(turn) > 0.5 * np.linalg.norm(first) * np.linalg.norm(second):
            break
    else:
        raise BoardNotFound("calibration board not found: the spots seen lie on one line, not on a grid")
    second = second if turn > 0 else -second
    has = [
        (np.hypot(*(points[near[:, 1:]] - points[:, None] - step).transpose(2, 0, 1)) < 0.15 * scale).any(axis=1)
        for step in (first, -first, second, -second)
    ]
    complete = np.sum(has, axis=0)
    middle = np.median(points[complete == complete.max()], axis=0)
    return first, second, int(np.lexsort((np.hypot(*(points - middle).T), -complete))[0])


def _closest_of_each(labels: np.ndarray, miss: np.ndarray) -> np.ndarray:
    """True for the point that lies closest to its lattice point, where several claim the same one."""
    order = np.argsort(miss, kind="stable")
    _, first = np.unique(labels[order], axis=0, return_index=True)
    closest = np.zeros(len(labels), dtype=bool)
    closest[order[first]] = True
    return closest


def _fit_lattice(labels: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Homography from lattice to picture; an affine map while there are too few points for perspective."""
    if len(labels) >= 12 and np.ptp(labels, axis=0).min() >= 2:
        homography, _ = cv2.findHomography(labels.astype(float), points)
        if homography is not None:
            return homography
    affine, *_ = np.linalg.lstsq(np.column_stack([labels, np.ones(len(labels))]), points, rcond=None)
    return np.vstack([affine.T, [0.0, 0.0, 1.0]])


def _match_whole_grid(labels: np.ndarray, points: np.ndarray, board: SpotBoard) -> tuple[np.ndarray, np.ndarray]:
    """Row and column on the board of each lattice point, by the grid's extent and its rotation in the picture."""
    fits = []  # (how much columns run to the right, row, col)
    col, row = labels.T
    for _ in range(4):
        col, row = -row, col
        if np.ptp(row) == board.rows - 1 and np.ptp(col) == board.cols - 1:
            steps = np.linalg.lstsq(np.column_stack([col, row, np.ones(len(col))]), points, rcond=None)[0]
            fits.append((steps[0, 0] / np.linalg.norm(steps[0]), row - row.min(), col - col.min()))
    if not fits:
        extent = sorted(int(reach) + 1 for reach in np.ptp(labels, axis=0))
        raise BoardNotFound(
            f"calibration board not found: a grid of {extent[0]} x {extent[1]} spots was seen, and not one of "
            f"{board.rows} rows and {board.cols} columns; without big spots all of it must be in the picture"
        )
    _, row, col = max(fits, key=lambda fit: fit[0])
    return row, col


def _match_big_spots(labels: np.ndarray, is_big: np.ndarray, board: SpotBoard) -> tuple[np.ndarray, np.ndarray]:
    """Row and column on the board of each lattice point, by the pattern of big spots.

    A blob of the right size scores 1, one of the wrong size or outside the board -1. A spot that is missing does not
    count: it may be unlit.
    """
    expected = np.full((board.rows, board.cols), -1)
    for row, col in board.big:
        expected[row, col] = 1
    seen = np.where(is_big, 1, -1)
    fits = []  # (score, row, col)
    col, row = labels.T
    for _ in range(4):
        col, row = -row, col
        for row_shift in range(-row.max(), board.rows - row.min()):
            for col_shift in range(-col.max(), board.cols - col.min()):
                r, c = row + row_shift, col + col_shift
                inside = (r >= 0) & (r < board.rows) & (c >= 0) & (c < board.cols)
                score = -np.count_nonzero(~inside) + int(np.sum(seen[inside] * expected[r[inside], c[inside]]))
                fits.append((score, r, c))
    fits.sort(key=lambda fit: -fit[0])
    (best, row, col), (second, *_) = fits[:2]
    if best - second < _MIN_MARGIN or best < len(labels) - _MAX_LOSS:
        raise BoardNotFound(
            f"calibration board not found: {len(labels)} spots of a grid were seen, {np.count_nonzero(is_big)} of them "
            f"big, which does not tell how the board lies; its {len(board.big)} big spots must be in the picture"
        )
    return row, col
