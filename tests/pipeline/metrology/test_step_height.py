"""Steps of known height on profiles and areas, tilted, rounded and noisy."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import chi2

from greenough.instrument.errors import InputError
from greenough.pipeline.metrology.step_height import groove_sides, step_height

EDGES = (-0.3, 0.9)  # W = 1.2 about 0.3


def groove(x: np.ndarray, depth: float) -> np.ndarray:
    return np.where((x > EDGES[0]) & (x < EDGES[1]), -depth, 0.0)


def test_windows_are_thirds():
    """Of W = 1.2 from -0.3 to 0.9: bottom 0.1 ... 0.5, plateaus -1.5 ... -0.7 and 1.3 ... 2.1."""
    x = np.array([-1.51, -1.49, -0.71, -0.69, -0.31, 0.09, 0.11, 0.49, 0.51, 0.91, 1.29, 1.31, 2.09, 2.11])
    np.testing.assert_array_equal(groove_sides(x, EDGES), [0, 1, 1, 0, 0, 0, -1, -1, 0, 0, 0, 1, 1, 0])


def test_a_tilted_profile_gives_its_depth_and_tilt_whatever_lies_outside_the_windows():
    x = np.linspace(-2, 3, 2001) + 0.00125  # no point on a window's border
    sides = groove_sides(x, EDGES)
    z = np.where(sides == 0, 7.0, 0.05 * x + 0.3 + groove(x, 0.1))
    step = step_height(x[:, None], z, sides)
    assert step.height == pytest.approx(0.1, abs=1e-12)
    assert step.slope == pytest.approx((0.05,))
    assert step.residual_rms < 1e-12
    assert (step.n_plateaus, step.n_bottom, step.n) == (640, 160, 800)


@settings(max_examples=40)
@given(
    height=st.floats(-2, 2), a=st.floats(-0.5, 0.5), b=st.floats(-0.5, 0.5), c=st.floats(-50, 50),
    shift=st.tuples(st.floats(-50, 50), st.floats(-50, 50)), seed=st.integers(0, 2**32 - 1),
)  # fmt: skip
def test_an_areal_step_does_not_change_with_tilt_place_or_order(height, a, b, c, shift, seed):
    rng = np.random.default_rng(seed)
    xy = np.column_stack([rng.uniform(-1.5, 2.1, 500), rng.uniform(-2, 2, 500)])
    noise = 1e-3 * rng.standard_normal(500)
    sides = groove_sides(xy[:, 0], EDGES)
    plain = step_height(xy, groove(xy[:, 0], height) + noise, sides)
    order = rng.permutation(500)
    tilted = groove(xy[:, 0], height) + noise + xy @ [a, b] + c
    moved = step_height((xy + shift)[order], tilted[order], sides[order])
    assert moved.height == pytest.approx(plain.height, abs=1e-9)
    assert moved.residual_rms == pytest.approx(plain.residual_rms, rel=1e-6)
    np.testing.assert_allclose(np.subtract(moved.slope, plain.slope), [a, b], atol=1e-9)


def test_a_raised_step_is_negative_and_a_step_with_one_edge_has_sides_of_its_own():
    x = np.linspace(-2, 3, 2001)
    assert step_height(x[:, None], groove(x, -0.1), groove_sides(x, EDGES)).height == pytest.approx(-0.1)
    sides = np.where(np.abs(x) < 0.2, 0, np.sign(x)).astype(int)
    assert step_height(x[:, None], 0.02 * x + 0.5 * (x > 0), sides).height == pytest.approx(0.5)


@pytest.mark.parametrize("areal", [False, True])
def test_bias_and_scatter_of_many_steps_are_those_predicted(areal):
    """1000 steps: mean within 4.5 sd, variance within chi2's limits at 1e-5; of that predicted by each and by theory.

    Without tilt in the regression the variance would be 4 σ² (1/n+ + 1/n-) / 4; a symmetric groove does not correlate
    with tilt, and the same holds.
    """
    rng, repeats, sigma = np.random.default_rng(4), 1000, 2e-3
    x = np.linspace(-1.5, 2.1, 181)
    sides = groove_sides(x, EDGES)
    places = np.column_stack([x, np.tile([0.0, 1.0, 0.5], 61)[:181]]) if areal else x[:, None]
    steps = [step_height(places, groove(x, 0.1) + sigma * rng.standard_normal(181), sides) for _ in range(repeats)]
    heights = np.array([step.height for step in steps])
    theory = sigma * np.sqrt(1 / steps[0].n_plateaus + 1 / steps[0].n_bottom)
    assert abs(heights.mean() - 0.1) < 4.5 * theory / np.sqrt(repeats)
    low, high = chi2.ppf([0.5e-5, 1 - 0.5e-5], repeats - 1) / (repeats - 1)
    assert low < heights.var(ddof=1) / theory**2 < high
    assert np.mean([step.sd**2 for step in steps]) == pytest.approx(theory**2, rel=0.03)


def test_what_was_not_measured_does_not_count():
    x = np.linspace(-2, 3, 2001)
    z = groove(x, 0.1)
    z[::2] = np.nan
    step = step_height(x[:, None], z, groove_sides(x, EDGES))
    assert step.height == pytest.approx(0.1)
    assert step.n == 400


def test_steps_that_cannot_be_told_are():
    x = np.linspace(-2, 3, 2001)[:, None]
    sides = groove_sides(x[:, 0], EDGES)
    for call, told in (
        (lambda: groove_sides(x, (1.0, 1.0)), "no width"),
        (lambda: step_height(x, groove(x[:, 0], 1.0), np.abs(sides)), "0 on the bottom"),
        (lambda: step_height(x, np.full(2001, np.nan), sides), "0 points on the plateaus"),
        (lambda: step_height(np.sign(x), groove(x[:, 0], 1.0), np.sign(x[:, 0])), "do not tell a step from a tilt"),
        (lambda: step_height(x[:, 0], groove(x[:, 0], 1.0), sides), "shapes"),
    ):
        with pytest.raises(InputError, match=told):
            call()
