"""Claims about the stage's errors. Chance refuses a sound stage in one run out of a million per test."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import chi2, norm

from greenough.twin.settings import StageSettings
from greenough.twin.stage import CORRELATION_MM, ErrorCurve, StageErrors, build_stage

FALSE_ALARM = 1e-6
CURVES = {
    "height": 3.3e-3,
    "straight_x": 2e-3,
    "straight_y": 2e-3,
    "pitch": 1e-4,
    "roll": 1e-4,
}
PERFECT = StageSettings(position_sd_um=0, straightness_sd_um=0, pitch_roll_sd_urad=0, axis_sd_deg=0)

positions = st.floats(-1.6, 1.6)
seeds = st.integers(0, 2**32 - 1)


@pytest.fixture(scope="module")
def stages() -> list[StageErrors]:
    return [build_stage(StageSettings(), seed) for seed in range(600)]


def at(stages: list[StageErrors], name: str, z: float) -> np.ndarray:
    """One error of all stages at a position, in its standard deviation."""
    curves: list[ErrorCurve] = [getattr(stage, name) for stage in stages]
    return np.array([curve(z) for curve in curves]) / CURVES[name]


@pytest.mark.parametrize("name", CURVES)
def test_over_many_stages_each_error_has_its_standard_deviation_at_any_position(stages, name):
    for z in (-1.45, 0.0, 0.7):
        assert abs(at(stages, name, z).sum()) < norm.isf(FALSE_ALARM / 6) * np.sqrt(len(stages))
    # 0.2 mm apart errors are as good as independent: so many values tell a few per cent.
    values = np.stack([at(stages, name, z) for z in np.arange(-1.5, 1.51, 0.2)])
    low, high = chi2.ppf([FALSE_ALARM / 2, 1 - FALSE_ALARM / 2], values.size)
    assert low < np.sum(values**2) < high


@pytest.mark.parametrize("name", CURVES)
def test_errors_of_neighbouring_calibration_heights_are_independent(stages, name):
    here, next_height = at(stages, name, 0.3), at(stages, name, 0.4)
    limit = norm.isf(FALSE_ALARM / 2) / np.sqrt(len(stages)) + np.exp(-((0.1 / CORRELATION_MM) ** 2) / 2)
    assert abs(np.corrcoef(here, next_height)[0, 1]) < limit


def test_the_errors_of_one_stage_are_independent_of_each_other(stages):
    table = np.stack([at(stages, name, 0.1) for name in CURVES])
    r = np.corrcoef(table)[np.triu_indices(len(CURVES), 1)]
    assert np.abs(r).max() < norm.isf(FALSE_ALARM / 2 / len(r)) / np.sqrt(len(stages))


def test_errors_are_correlated_like_a_gaussian_over_the_stated_length(stages):
    here = at(stages, "height", -0.5)
    for share in (0.3, 1.0, 2.0):
        r = np.mean(here * at(stages, "height", -0.5 + share * CORRELATION_MM))
        # The standard deviation of the mean of a product of two unit normals is at most sqrt(2 / n).
        assert r == pytest.approx(np.exp(-(share**2) / 2), abs=norm.isf(FALSE_ALARM / 6) * np.sqrt(2 / len(stages)))


def test_over_a_micrometre_a_stage_moves_smoothly(stages):
    step = 1e-3
    increments = at(stages, "height", 0.2 + step) - at(stages, "height", 0.2)
    expected = step / CORRELATION_MM  # the slope of a Gaussian process of that correlation, in its sd per mm
    assert np.sqrt(np.mean(increments**2)) == pytest.approx(expected, rel=0.25)
    assert np.abs(increments).max() < 6 * expected


def test_the_axis_leans_by_its_standard_deviation(stages):
    tilts = np.degrees([stage.axis_tilt for stage in stages]) / 0.2
    low, high = chi2.ppf([FALSE_ALARM / 2, 1 - FALSE_ALARM / 2], tilts.size)
    assert low < np.sum(tilts**2) < high


@settings(max_examples=30)
@given(seeds, positions)
def test_a_perfect_stage_is_exactly_where_it_reads(seed, z):
    expected = np.eye(4)
    expected[2, 3] = z
    np.testing.assert_array_equal(build_stage(PERFECT, seed).twin_from_table(z), expected)


@settings(max_examples=30)
@given(seeds, positions)
def test_a_stage_is_the_same_every_time_and_moves_rigidly(seed, z):
    motion = build_stage(StageSettings(), seed).twin_from_table(z)
    np.testing.assert_array_equal(motion, build_stage(StageSettings(), seed).twin_from_table(z))
    np.testing.assert_allclose(motion[:3, :3] @ motion[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(motion[:3, :3]) > 0


@settings(max_examples=30)
@given(seeds, positions)
def test_switching_one_error_off_leaves_the_others(seed, z):
    full = build_stage(StageSettings(), seed)
    less = build_stage(StageSettings(position_sd_um=0, pitch_roll_sd_urad=0), seed)
    assert less.straight_x(z) == full.straight_x(z)
    assert less.straight_y(z) == full.straight_y(z)
    assert less.height(z) == 0
    np.testing.assert_array_equal(less.axis_tilt, full.axis_tilt)


def test_twice_the_size_is_twice_the_error():
    one, two = (build_stage(StageSettings(position_sd_um=sd), 3) for sd in (5.0, 10.0))
    assert two.height(0.4) == pytest.approx(2 * one.height(0.4))
