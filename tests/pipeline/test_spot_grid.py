import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from greenough.instrument.contract import SpotBoard
from greenough.pipeline.spot_grid import BoardNotFound, order_spots

BOARD = SpotBoard(9, 11, 0.65, 0.4, 0.175, 8.0, ((4, 5), (4, 6), (3, 5), (4, 3), (6, 5)))
PX_PER_MM = 101.0


def imaged(turn: float, tilt: float, towards: float, distance: float = 224.56) -> tuple[np.ndarray, np.ndarray]:
    """Centres and areas in px of the board's spots by plain perspective: x right, y up becomes v down."""
    turned = BOARD.centres() @ np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    along = turned @ [np.cos(towards), np.sin(towards)]
    across = turned @ [-np.sin(towards), np.cos(towards)]
    magnification = PX_PER_MM * distance / (distance + along * np.sin(tilt))
    x, y = magnification * (along * np.cos(tilt)), magnification * across
    u, v = x * np.cos(towards) - y * np.sin(towards), x * np.sin(towards) + y * np.cos(towards)
    areas = np.pi / 4 * BOARD.diameters() ** 2 * magnification**2 * np.cos(tilt)
    return np.stack([640 + u, 480 - v], axis=-1), areas


@pytest.mark.slow
@given(
    turn=st.floats(0, 2 * np.pi),
    tilt=st.floats(0, np.radians(30)),
    towards=st.floats(0, 2 * np.pi),
    lost=st.integers(0, 35),
    foreign=st.integers(0, 8),
    seed=st.integers(0, 2**32 - 1),
)
def test_every_spot_gets_its_own_place_in_any_posture(turn, tilt, towards, lost, foreign, seed):
    """Small spots missing anywhere, dust among them, centres and areas uncertain, in any order of blobs."""
    rng = np.random.default_rng(seed)
    centres, areas = imaged(turn, tilt, towards)
    small = np.setdiff1d(np.arange(99), [row * 11 + col for row, col in BOARD.big])
    kept = np.setdiff1d(np.arange(99), rng.choice(small, lost, replace=False))
    dust = rng.uniform([0, 0], [1280, 960], (foreign, 2))
    blobs = np.concatenate([centres[kept] + rng.normal(0, 0.5, (len(kept), 2)), dust])
    sizes = np.concatenate([areas[kept] * rng.uniform(0.85, 1.15, len(kept)), rng.uniform(20, 80, foreign)])
    shuffled = rng.permutation(len(blobs))

    index = order_spots(blobs[shuffled], sizes[shuffled], BOARD)

    expected = np.full(99, -1)
    expected[kept] = np.argsort(shuffled)[: len(kept)]
    # A spot may go unseen where dust stole its place, but none may get another's.
    assert np.all((index == expected) | (index == -1) | (shuffled[index] >= len(kept)))
    assert np.count_nonzero(index == expected) >= 99 - foreign


def test_half_a_board_is_enough_when_the_big_spots_are_in_it():
    centres, areas = imaged(0.4, 0.3, 1.0)
    half = np.flatnonzero(BOARD.centres()[:, 0] > -1.4)
    index = order_spots(centres[half], areas[half], BOARD)
    assert np.array_equal(np.flatnonzero(index >= 0), half)
    assert np.array_equal(half[index[half]], half)


def test_a_part_without_big_spots_is_refused_because_it_fits_anywhere():
    centres, areas = imaged(0.0, 0.1, 0.0)
    corner = np.flatnonzero(BOARD.centres()[:, 0] > 0.7)
    with pytest.raises(BoardNotFound, match=f"{len(corner)} spots of a grid were seen, 0 of them big"):
        order_spots(centres[corner], areas[corner], BOARD)


@pytest.mark.parametrize("turn", [0.0, 0.8, 2.0, 4.0])
def test_a_mirrored_board_is_refused(turn):
    centres, areas = imaged(turn, 0.2, 0.5)
    with pytest.raises(BoardNotFound):
        order_spots(centres * [-1, 1] + [1280, 0], areas, BOARD)


def test_too_few_blobs_are_counted_in_the_message():
    centres, areas = imaged(0.0, 0.0, 0.0)
    with pytest.raises(BoardNotFound, match="7 spots of a grid were seen, but at least 20 of its 99"):
        order_spots(centres[:7], areas[:7], BOARD)


def test_random_blobs_are_no_board():
    rng = np.random.default_rng(5)
    for _ in range(20):
        with pytest.raises(BoardNotFound):
            order_spots(rng.uniform([0, 0], [1280, 960], (120, 2)), rng.uniform(50, 1300, 120), BOARD)


def test_spots_on_one_line_are_no_board():
    blobs = np.column_stack([np.arange(30) * 40.0, np.full(30, 300.0)])
    with pytest.raises(BoardNotFound):
        order_spots(blobs, np.full(30, 250.0), BOARD)


def plain(rows: int, cols: int) -> SpotBoard:
    """A grid of spots that are all alike."""
    return SpotBoard(rows, cols, 0.65, 0.3, 0.3, 8.0, ())


def laid(board: SpotBoard, turn_deg: float) -> tuple[np.ndarray, np.ndarray]:
    """Centres and areas of a board turned in its plane, v downwards."""
    cosine, sine = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))
    x, y = (board.centres() @ [[cosine, sine], [-sine, cosine]]).T * PX_PER_MM
    return np.stack([640 + x, 480 - y], axis=-1), np.pi / 4 * board.diameters() ** 2 * PX_PER_MM**2


@pytest.mark.parametrize(("rows", "cols", "reach"), [(7, 7, 44), (5, 8, 89)])
def test_spots_that_are_all_alike_are_told_by_the_whole_grid_and_by_how_it_is_turned(rows, cols, reach):
    """A square grid within 45 degrees, one of fewer rows than columns within 90."""
    board = plain(rows, cols)
    for turn in (-reach, -20, 0, 30, reach):
        centres, areas = laid(board, turn)
        shuffled = np.random.default_rng(1).permutation(len(centres))
        index = order_spots(centres[shuffled], areas[shuffled], board)
        assert np.array_equal(shuffled[index], np.arange(rows * cols))
        lost = np.delete(np.arange(rows * cols), [3, 20])  # not a whole row, nor a column
        index = order_spots(centres[lost], areas[lost], board)
        assert np.array_equal(np.flatnonzero(index < 0), [3, 20])
        assert np.array_equal(lost[index[index >= 0]], lost)


def test_a_grid_of_spots_that_are_all_alike_is_refused_where_a_row_is_not_in_the_picture():
    board = plain(6, 8)
    centres, areas = laid(board, 10)
    with pytest.raises(BoardNotFound, match="a grid of 5 x 8 spots was seen, and not one of 6 rows and 8 columns"):
        order_spots(centres[8:], areas[8:], board)
