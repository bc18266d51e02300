"""Claims about what stage and board as built do to heights: shapes that a fit per place takes for flat."""

from types import SimpleNamespace

import numpy as np
import pytest

from greenough.twin.instability import Instability
from greenough.twin.settings import StabilitySettings, TwinSettings
from greenough.twin.validation.mechanics import (
    Drift,
    calibration_drift,
    calibration_noise,
    calibration_noise_share,
    expected_error,
    field_grid,
    left_to_chance,
    percentile_with_noise,
    systematic_error,
)

READINGS = np.linspace(-1.45, 1.45, 30)
HEIGHTS = np.array([-1.2, 0.0, 0.9])


def error_of(analytic, blank_face_height) -> np.ndarray:
    return systematic_error(analytic(blank_face_height=blank_face_height).bench, READINGS, HEIGHTS)


def test_an_ideal_stage_and_board_make_no_error(analytic):
    np.testing.assert_allclose(error_of(analytic, lambda z, xy: np.full(len(xy), z)), 0, atol=1e-12)


def test_the_blank_face_s_shape_comes_back_with_the_opposite_sign(analytic):
    def shape(xy):
        return 1e-3 * (0.3 * xy[:, 0] + 0.1 * xy[:, 1] ** 2)

    error = error_of(analytic, lambda z, xy: z + shape(xy))
    np.testing.assert_allclose(error, np.tile(-shape(field_grid()), (3, 1)), atol=1e-9)


def test_a_stage_that_goes_too_far_makes_heights_too_small(analytic):
    error = error_of(analytic, lambda z, xy: np.full(len(xy), 1.001 * z))
    np.testing.assert_allclose(error, np.tile((HEIGHTS * (1 / 1.001 - 1))[:, None], len(field_grid())), atol=1e-9)


def test_heights_may_differ_from_place_to_place(analytic):
    bench = analytic(blank_face_height=lambda z, xy: np.full(len(xy), 1.001 * z)).bench
    places = np.array([[0.0, 0.0], [1.0, -2.0]])
    error = systematic_error(bench, READINGS, np.array([[0.5, -1.0]]), places)
    np.testing.assert_allclose(error, np.array([[0.5, -1.0]]) * (1 / 1.001 - 1), atol=1e-9)


def test_a_table_that_has_risen_makes_heights_too_small_by_as_much_as_since_the_blank_side_at_zero(analytic):
    drift = Drift(at_flat_posture=7e-3, at_zero=1e-3, planes=np.full(30, 3e-3))
    error = systematic_error(analytic().bench, READINGS, HEIGHTS, drift=drift)
    np.testing.assert_allclose(error, -1e-3, atol=1e-9)


def test_a_table_that_rises_with_the_planes_makes_the_scale_of_depth_too_small(analytic):
    error = systematic_error(analytic().bench, READINGS, HEIGHTS, drift=Drift(0.0, 0.0, 1e-3 * READINGS))
    np.testing.assert_allclose(error, np.tile((HEIGHTS * (1 / 1.001 - 1))[:, None], len(field_grid())), atol=1e-9)


def test_the_bundle_is_wrong_by_its_board_s_pitch_and_the_drift_until_the_flat_posture(analytic):
    setup = analytic(method="bundle")
    longer = analytic(method="bundle", printed_centres=1.0001 * setup.calibration.board.centres())
    np.testing.assert_allclose(expected_error(setup, HEIGHTS), 0, atol=1e-15)
    np.testing.assert_allclose(expected_error(longer, HEIGHTS), -1e-4 * HEIGHTS[:, None] * np.ones(169), rtol=1e-6)
    settings = TwinSettings(seed=5, stability=StabilitySettings(table_drift_um=20.0, path_drift_um=0.0))
    drifting = analytic(method="bundle", settings=settings)
    lag = calibration_drift(drifting).at_flat_posture
    assert abs(lag) > 1e-4
    np.testing.assert_allclose(expected_error(drifting, HEIGHTS), -lag, rtol=1e-9)


def test_drift_is_the_table_s_at_the_calibration_s_last_captures(analytic):
    """24 frames each: 30 planes, the blank side at 0 before them, and the flat posture before that."""
    settings = TwinSettings(seed=5, stability=StabilitySettings(table_drift_um=2.0))
    setup = analytic(settings=settings)
    drift = calibration_drift(setup)
    end = setup.calibration.exposures
    walk = Instability(settings.stability, 5, "calibration", 46 * 24)
    assert drift.planes[-1] == walk.table_drift(end - 24)[2]
    assert drift.planes[0] == walk.table_drift(end - 30 * 24)[2]
    assert drift.at_zero == walk.table_drift(end - 31 * 24)[2]
    assert drift.at_flat_posture == walk.table_drift(end - 32 * 24)[2]


def test_chance_is_the_drift_of_the_paths_seen_as_height(analytic):
    """0.05 um sideways are 0.239 um of height under 12 degrees: known to 7 % from 100 draws, to 25 % here. Where the
    heights are counted from, the calibration's drift has gone one step of 46 only."""
    settings = TwinSettings(seed=5, stability=StabilitySettings(path_drift_um=0.05))
    own = left_to_chance(analytic(method="bundle", settings=settings), np.zeros((1, 2)), 46 * 24)
    whole = 0.05e-3 / (2 * np.sin(np.radians(6)))
    assert own.std() == pytest.approx(whole, rel=0.25)
    both = left_to_chance(analytic(settings=settings), np.zeros((1, 2)), 46 * 24)
    assert 0 < (both - own).std() < 2 * whole / np.sqrt(46)
    assert np.ptp(both, axis=2).max() < 1e-15
    assert left_to_chance(analytic(), np.zeros((1, 2)), 46 * 24).std() == 0


def test_heights_early_in_their_run_have_drifted_less_and_lie_on_one_walk(analytic):
    """Standard deviations of 100 draws, each known to 7 %."""
    settings = TwinSettings(seed=5, stability=StabilitySettings(path_drift_um=0.05))
    setup, whole = analytic(method="bundle", settings=settings), 0.05e-3 / (2 * np.sin(np.radians(6)))
    first, early, late = (left_to_chance(setup, np.zeros((1, 1)), n * 24)[:, 0, 0] for n in (0, 9, 13))
    assert np.abs(first).max() == 0
    assert early.std() == pytest.approx(whole * np.sqrt(9 / 46), rel=0.3)
    assert (late - early).std() == pytest.approx(whole * np.sqrt(4 / 46), rel=0.3)


def test_heights_are_counted_from_the_field_whichever_places_are_asked_for(analytic):
    """The pipeline's zero is one mean over the blank side at 0: for a bow over the field, not that of the corner."""

    def bowed(reading: float, xy: np.ndarray) -> np.ndarray:
        return reading + 1e-3 * xy[:, 0] ** 2

    bench = analytic(blank_face_height=lambda z, xy: bowed(z, xy) + (z > -0.07) * (z < 0.03) * 1e-4 * xy[:, 1]).bench
    everywhere = systematic_error(bench, READINGS, HEIGHTS)
    corner = field_grid()[-5:]
    np.testing.assert_allclose(systematic_error(bench, READINGS, HEIGHTS, corner), everywhere[:, -5:], atol=1e-12)
    assert systematic_error(bench, READINGS, HEIGHTS, corner[:0]).shape == (3, 0)


def test_noise_of_the_calibration_s_planes_is_told_from_the_stage(analytic):
    """Cubics through 30 planes with noise of 1.8 um and 3 um of the stage, which is common to all pixels."""
    rng, planes = np.random.default_rng(4), READINGS
    powers = np.vander(planes, 4)
    stage = rng.normal(0, 3.0, 30)
    z = stage[:, None] + rng.normal(0, 1.8, (30, 80 * 256))
    left = (z - powers @ np.linalg.lstsq(powers, z, rcond=None)[0]).astype(np.float32)
    setup = analytic()
    assert calibration_noise(setup) is None
    blocks = left.reshape(30, 8, 10, 256).mean(axis=-1)
    setup.calibration.residuals = SimpleNamespace(pixels_um=np.sqrt(np.mean(left**2, axis=0)), planes_um=blocks)
    assert calibration_noise(setup) == pytest.approx(1.8e-3, rel=0.01)


def test_a_drift_of_the_paths_during_the_planes_tilts_the_scale_of_depth_by_the_paper_s_method(analytic):
    """Beside random walks that are fitted here in another way: two standard deviations that are each known to 7 %."""
    settings = TwinSettings(seed=5, stability=StabilitySettings(path_drift_um=0.05))
    heights = np.array([[-1.25], [1.25]])
    low, high = left_to_chance(analytic(settings=settings), heights, 0)[..., 0].T
    rng, step = np.random.default_rng(9), 0.05e-3 / (2 * np.sin(np.radians(6))) / np.sqrt(46)
    steps = []
    for _ in range(100):
        fit = np.polynomial.Polynomial.fit(READINGS, READINGS - np.cumsum(rng.normal(0, step, 30)), 3)
        steps.append(fit(1.25) - fit(-1.25))
    assert np.std(high - low) == pytest.approx(np.std(steps), rel=0.45)
    bundle = left_to_chance(analytic(method="bundle", settings=settings), heights, 5 * 24)[..., 0]
    assert np.ptp(bundle, axis=1).max() == 0


@pytest.mark.slow
def test_noise_of_the_calibration_is_that_of_a_cubic_through_its_planes(analytic):
    """2000 cubics through 30 planes of unit noise: their standard deviations are known to 1.6 %."""
    heights = np.linspace(-1.45, 1.45, 9)
    noise = np.random.default_rng(10).standard_normal((30, 2000))
    powers = np.vander(READINGS, 4)
    fitted = np.vander(heights, 4) @ np.linalg.lstsq(powers, noise, rcond=None)[0]
    for k in (0, 4):
        share = calibration_noise_share(analytic(), heights[k : k + 1])
        assert share == pytest.approx(fitted[k].std(), rel=0.08)
    assert calibration_noise_share(analytic(), heights) == pytest.approx(np.sqrt(np.mean(fitted**2)), rel=0.05)
    assert calibration_noise_share(analytic(method="bundle"), heights) == 0


def test_percentile_with_noise_is_the_folded_normal_s_about_a_bias():
    # 199 deviates stand for the normal distribution: between 0.945 and 0.955, so to 3 %.
    assert percentile_with_noise(np.zeros(100), 1e-3, 0.95) == pytest.approx(1.96e-3, rel=0.03)
    assert percentile_with_noise(np.full(100, 0.1), 1e-3, 0.95) - 0.1 == pytest.approx(1.645e-3, rel=0.03)


def test_where_fewer_planes_are_seen_their_errors_count_for_more(analytic):
    """A stage that is 5 um too high in its upper half: who saw the lower half alone makes no error there."""

    def jumping(reading: float, xy: np.ndarray) -> np.ndarray:
        return np.full(len(xy), reading + (5e-3 if reading > 0.2 else 0.0))

    setup = analytic(blank_face_height=jumping)
    heights = np.full((1, 2), -1.0)
    everything, lower = [[-1.45, 1.45], [-1.45, 0.15]]
    error = expected_error(setup, heights, np.zeros((2, 2)), np.array([everything, lower]))[0]
    whole = expected_error(setup, heights, np.zeros((2, 2)))[0]
    assert whole[0] == whole[1]
    assert abs(error[0] - error[1]) > 0.1e-3
    alone = expected_error(setup, heights[:, :1], np.zeros((1, 2)), np.array([lower]))
    assert alone[0, 0] == error[1]
