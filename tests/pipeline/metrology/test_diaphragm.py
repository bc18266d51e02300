"""Clamped plates whose volume, stroke and profile are known."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from greenough.instrument.errors import InputError
from greenough.pipeline.metrology.diaphragm import (
    DiaphragmState,
    Outline,
    column_profile,
    measure_state,
    row_profile,
    stroke,
    volume,
    volume_between,
)
from greenough.pipeline.reconstruct import PointMap

RADIUS, RIM = 3.4, 3.7
PUPIL = 224.56


def plate(r: np.ndarray, deflection: float) -> np.ndarray:
    """Height of a clamped circular plate under even pressure; its volume is π R² w / 3."""
    return deflection * np.maximum(0.0, 1 - (r / RADIUS) ** 2) ** 2


def plate_volume(deflection: float) -> float:
    return np.pi * RADIUS**2 * deflection / 3


def seen(deflection: float, noise: float = 0.0, rng: np.random.Generator | None = None, px: int = 260) -> PointMap:
    """A map as a camera above sees it: places move towards the axis where the surface is high; nothing past the rim."""
    grid = np.linspace(-3.8, 3.8, px)
    x0, y0 = np.meshgrid(grid, grid)
    z = np.zeros_like(x0)
    for _ in range(20):  # the ray through (x0, y0, 0) meets the surface where x = x0 (1 - z / H)
        shrink = 1 - z / PUPIL
        z = plate(np.hypot(x0, y0) * shrink, deflection)
    xyz = np.stack([x0 * shrink, y0 * shrink, z], axis=-1)
    if rng is not None:
        xyz[..., 2] += noise * rng.standard_normal(z.shape)
    xyz[np.hypot(x0, y0) > RIM] = np.nan
    return PointMap(xyz)


def laid(points: PointMap, rotation: Rotation, shift: np.ndarray) -> PointMap:
    return PointMap(rotation.apply(points.xyz.reshape(-1, 3)).reshape(points.xyz.shape) + shift)


CENTRED = Outline((0.0, 0.0), RADIUS, RIM)


def measured(deflection: float) -> DiaphragmState:
    return measure_state(seen(deflection), CENTRED)


@pytest.mark.parametrize("deflection", [-1.38, 0.25, 1.38])
def test_the_volume_is_the_integral(deflection):
    """Worked out by hand, and summed over random places: a second path to the same number."""
    found = volume(measured(deflection))
    assert found.volume == pytest.approx(plate_volume(deflection), rel=1e-3)
    r = RADIUS * np.sqrt(np.random.default_rng(1).uniform(size=200_000))
    heights = plate(r, deflection)
    sd = np.pi * RADIUS**2 * heights.std() / np.sqrt(len(r))
    assert abs(found.volume - np.pi * RADIUS**2 * heights.mean()) < 4.5 * sd + 1e-3 * abs(found.volume)
    assert (found.missing_share, found.missing_at_most) == (0.0, 0.0)
    assert found.n == pytest.approx(np.pi * 50**2, rel=0.01)


def test_between_two_states_lies_the_difference_of_their_volumes_and_deflections():
    low, high = measured(-1.38), measured(1.38)
    assert volume_between(low, high).volume == pytest.approx(plate_volume(2.76), rel=1e-3)
    assert volume_between(high, low).volume == pytest.approx(-plate_volume(2.76), rel=1e-3)
    # Over a tenth of the radius a plate departs from a parabola by (r / R)⁴ at most: 1e-4 of the deflection.
    assert stroke(low, high).stroke == pytest.approx(2.76, rel=1e-4)


@settings(max_examples=8)
@given(
    turn=st.floats(-3, 3), tilt=st.tuples(st.floats(-0.05, 0.05), st.floats(-0.05, 0.05)),
    shift=st.tuples(*[st.floats(-5, 5)] * 3),
)  # fmt: skip
def test_it_does_not_matter_how_the_part_lies(turn, tilt, shift):
    lies = Rotation.from_rotvec([*tilt, 0]) * Rotation.from_rotvec([0, 0, turn])
    points = laid(seen(0.8), lies, np.array(shift))
    moved = measure_state(points, Outline((shift[0], shift[1]), RADIUS, RIM))
    still = measured(0.8)
    assert volume(moved).volume == pytest.approx(volume(still).volume, rel=1e-3)
    assert stroke(still, moved).stroke == pytest.approx(0, abs=1e-4)
    assert np.abs(moved.rim.residuals).max() < 1e-9


def test_a_rim_that_is_seen_on_one_side_only_moves_nothing():
    points = seen(0.8)
    points.xyz[points.xyz[..., 0] > 2.0] = np.nan
    state = measure_state(points, CENTRED)
    assert state.centre_height == pytest.approx(0.8, rel=1e-4)
    whole = np.isfinite(state.heights) & (np.arange(100) * state.cell - RADIUS < 1.9)  # no cell cut at 2 mm
    np.testing.assert_allclose(state.heights[whole], measured(0.8).heights[whole], atol=1e-6)


def test_what_is_missing_is_stated_and_its_volume_is_below_the_bound():
    points = seen(1.0)
    hole = np.hypot(points.xyz[..., 0] - 1.0, points.xyz[..., 1]) < 0.7
    points.xyz[hole] = np.nan
    found = volume(measure_state(points, CENTRED))
    assert found.missing_share == pytest.approx((0.7 / RADIUS) ** 2, rel=0.1)
    lacks = plate_volume(1.0) - found.volume
    assert 0.5 * found.missing_at_most < lacks < found.missing_at_most


def test_a_hole_in_either_state_is_missing_between_them():
    holes = [seen(d) for d in (0.0, 1.0)]
    for points, at in zip(holes, (-1.5, 1.5), strict=True):
        points.xyz[np.hypot(points.xyz[..., 0] - at, points.xyz[..., 1]) < 0.7] = np.nan
    first, second = (measure_state(points, CENTRED) for points in holes)
    between = volume_between(first, second)
    assert between.missing_share == pytest.approx(2 * (0.7 / RADIUS) ** 2, rel=0.1)
    assert between.missing_share == pytest.approx(volume(first).missing_share + volume(second).missing_share)


def test_the_centre_scatters_as_it_says():
    """200 captures with 3 um of noise: mean within 4.5 sd, variance within chi2's limits at 1e-5."""
    rng = np.random.default_rng(3)
    states = [measure_state(seen(0.5, 3e-3, rng, px=90), CENTRED) for _ in range(200)]
    heights, sd = np.array([s.centre_height for s in states]), np.sqrt(np.mean([s.centre_sd**2 for s in states]))
    assert abs(heights.mean() - 0.5) < 4.5 * sd / np.sqrt(200) + 0.5e-4
    low, high = chi2.ppf([0.5e-5, 1 - 0.5e-5], 199) / 199
    assert low < heights.var(ddof=1) / sd**2 < high
    both = stroke(states[0], states[1])
    assert both.sd == pytest.approx(np.hypot(states[0].centre_sd, states[1].centre_sd))
    assert both.n == (states[0].n_centre, states[1].n_centre)


def test_profiles_cross_the_plate_along_row_and_column():
    lies = Rotation.from_rotvec([0.02, -0.03, 0.0])
    points = laid(seen(0.8, px=261), lies, np.array([1.0, 2.0, 3.0]))
    points.xyz[130, 100:110] = np.nan
    outline = Outline((1.0, 2.0), RADIUS, RIM)
    rim = measure_state(points, outline).rim
    for profile, missing in (
        (row_profile(points, 130, rim, outline), 10), (column_profile(points, 130, rim, outline), 0),
    ):  # fmt: skip
        seen_there = np.isfinite(profile.height)
        np.testing.assert_allclose(profile.height[seen_there], plate(np.abs(profile.along[seen_there]), 0.8), atol=2e-3)
        span = np.flatnonzero(seen_there)
        assert profile.missing_share == pytest.approx(missing / (span[-1] - span[0] + 1))
        assert np.nanmin(profile.along) < -RADIUS < RADIUS < np.nanmax(profile.along)


def test_what_cannot_be_measured_is_told():
    points = seen(0.5)
    rim_only, nothing = PointMap(points.xyz.copy()), PointMap(np.full((9, 9, 3), np.nan))
    rim_only.xyz[np.hypot(points.xyz[..., 0], points.xyz[..., 1]) < 1.0] = np.nan
    state = measured(0.5)
    for call, told in (
        (lambda: measure_state(points, Outline((0, 0), 3.4, 3.4)), "rim must be outside"),
        (lambda: measure_state(points, Outline((30, 0), 3.4, 3.7)), "on the diaphragm's rim"),
        (lambda: measure_state(rim_only, CENTRED), "diaphragm's centre"),
        (lambda: volume_between(state, measure_state(points, Outline((0, 0), 3.3, 3.7))), "same outline"),
        (lambda: row_profile(nothing, 3, state.rim, CENTRED), "0 points"),
    ):
        with pytest.raises(InputError, match=told):
            call()
