"""Claims about distances between spots, on a board that is seen by an ideal camera."""

from types import SimpleNamespace

import numpy as np
import pytest

from greenough.instrument.contract import SpotBoard
from greenough.pipeline.decode import PhaseMap
from greenough.pipeline.spots import Spots
from greenough.twin.validation.pitch import (
    ERROR_MEAN_LIMIT_UM,
    ERROR_SD_LIMIT_UM,
    SECOND,
    all_pairs,
    board_claims,
    distance_errors,
    distance_noise,
    paper_pairs,
)


def test_pairs_are_neighbours_each_once(analytic):
    board = analytic().calibration.board
    centres = board.centres()
    for pairs, count in ((all_pairs(board), 9 * 10 + 8 * 11), (paper_pairs(board), 28 + 30)):
        assert len({tuple(sorted(pair)) for pair in pairs.tolist()}) == len(pairs) == count
        distances = np.linalg.norm(centres[pairs[:, 0]] - centres[pairs[:, 1]], axis=1)
        np.testing.assert_allclose(distances, board.pitch_mm, rtol=1e-12)


def test_distances_err_by_the_scale_and_unseen_spots_do_not_count(analytic):
    board = analytic().calibration.board
    printed, pairs = board.centres(), all_pairs(board)
    measured = 1.001 * printed + [3.0, -2.0]
    measured[0] = np.nan  # a corner, in two pairs
    errors = distance_errors(measured, printed, pairs)
    assert len(errors) == len(pairs) - 2
    np.testing.assert_allclose(errors, 0.001 * board.pitch_mm, rtol=1e-9)


def test_the_papers_pairs_lie_in_the_middle(analytic):
    board = analytic().calibration.board
    used = board.centres()[np.unique(paper_pairs(board))]
    assert len(used) == 35
    np.testing.assert_allclose(used.mean(axis=0), 0, atol=1e-12)


def printed_and_measured(board: SpotBoard, error_um: float, scale: float) -> tuple[np.ndarray, np.ndarray]:
    """Spots with print errors of 0.6 um per axis, and where they are found, (99, 3) each."""
    rng = np.random.default_rng(8)
    printed = np.column_stack([board.centres() + rng.normal(0, 0.6e-3, (99, 2)), np.zeros(99)])
    return printed, scale * printed + rng.normal(0, 1e-3 * error_um, (99, 3))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("error_um", "scale", "mean_holds", "sd_holds"),
    [(0.1, 1.0, True, True), (0.4, 1.0, True, False), (0.05, 1 + 3e-4, False, True)],
)
def test_the_second_board_is_judged_by_its_own_print(analytic, error_um, scale, mean_holds, sd_holds):
    """Errors of 0.1 um per axis make distances err by 0.14 um; a scale of 0.3 per mille, by 0.2 um each."""
    printed, measured = printed_and_measured(analytic().calibration.board, error_um, scale)
    specimen = SimpleNamespace(as_built={"centres_mm": printed})
    for method in ("bundle", "paper"):
        setup = analytic(method=method, specimen=specimen)
        rows = {row.claim: row for row in board_claims(setup, "second-board", SECOND, measured, 1.4e-4)}
        for suffix in ("", "_all_spots"):
            mean, sd = (rows[f"{SECOND}_error_{name}{suffix}"] for name in ("mean", "sd"))
            if method == "paper":
                assert mean.limit is sd.limit is None
                continue
            assert (mean.limit, sd.limit) == (ERROR_MEAN_LIMIT_UM, ERROR_SD_LIMIT_UM)
            assert (mean.holds, sd.holds, mean.expected_to_hold, sd.expected_to_hold) == (
                mean_holds,
                sd_holds,
                True,
                True,
            )
    assert {len(paper_pairs(setup.calibration.board)), rows[f"{SECOND}_error_mean"].n} == {58}
    assert rows[f"{SECOND}_error_mean_all_spots"].n == 178


def test_spread_of_distances_is_predicted_from_the_print(analytic):
    printed, measured = printed_and_measured(analytic().calibration.board, 0.1, 1.0)
    setup = analytic(specimen=SimpleNamespace(as_built={"centres_mm": printed}))
    for row in board_claims(setup, "second-board", SECOND, measured, np.sqrt(2) * 0.1e-3):
        if row.claim.endswith(("_sd", "_sd_all_spots")) and "error" not in row.claim:
            assert row.measured == pytest.approx(row.predicted, abs=4 * row.predicted_sd)
            assert row.predicted == pytest.approx(np.sqrt(2) * 0.6e-3, rel=0.3)


def test_noise_of_a_distance_is_that_of_both_spots_and_no_limit(analytic):
    """Centres to 0.01 px of 9.9 um, and heights of 1.6 um in discs of 0.8 * 20 px: 0.099 and 0.056 um a spot."""
    image = np.zeros((960, 1280))
    phase_map = PhaseMap(image, image, image, image == 0, image, np.full(image.shape, 1.6e-3))
    spots = Spots(np.zeros((99, 2)), np.full((99, 2), 20.0), np.full(99, 0.01))
    setup = analytic()
    noise = 1e3 * distance_noise(setup, phase_map, spots, 0.01)
    assert noise == pytest.approx(np.sqrt(2) * np.hypot(0.099, 0.0564), rel=0.01)
    rows = board_claims(
        analytic(specimen=SimpleNamespace(as_built={"centres_mm": np.zeros((99, 3))})), "board", "pitch",
        np.random.default_rng(1).normal(size=(99, 3)), 1e-3 * noise,
    )  # fmt: skip
    (row,) = (row for row in rows if row.claim == "pitch_sd")
    assert row.predicted_sd == pytest.approx(1e-3 * noise / np.sqrt(58))


def test_rows_of_a_board_whose_spots_were_not_seen_have_no_figure_and_do_not_hold(analytic):
    setup = analytic(method="bundle", specimen=SimpleNamespace(as_built={"centres_mm": np.zeros((99, 3))}))
    for row in board_claims(setup, "second-board", SECOND, np.full((99, 3), np.nan), 1e-4):
        assert np.isnan(row.measured)
        assert not row.holds
        assert row.n == 0
