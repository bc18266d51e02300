from math import pi

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import norm

from greenough.pipeline.fringes import PAPER, FringeSet
from greenough.pipeline.jit import Float
from greenough.pipeline.unwrap import order_is_safe, unwrap


def unwrapped(wrapped, variance, fringes):
    """`unwrap` on NumPy arrays: (sets, pixels) and one variance per set."""
    result = unwrap([Float(phase.astype(np.float32)) for phase in wrapped], [Float(v) for v in variance], fringes)
    return np.array(result.absolute), np.array(result.residual), np.array(result.resolved)


def phases(column, fringes):
    """Exact phases, (sets, pixels)."""
    return 2 * pi * np.asarray(column) / np.asarray(fringes.periods)[:, None]


def wrap(phase):
    return np.angle(np.exp(1j * phase))


@given(
    ratios=st.lists(st.floats(1.3, 8), min_size=1, max_size=3),
    share=st.lists(st.floats(0.01, 0.99), min_size=1, max_size=20),
    turns=st.integers(-1, 1),
)
@settings(max_examples=30)
def test_exact_phases_give_the_column_back_for_any_chain_of_ratios(ratios, share, turns):
    periods = 2000 / np.cumprod([1, *ratios])
    fringes = FringeSet(tuple(periods), (4,) * len(periods))
    column = np.array(share) * (periods[0] - 1)
    wrapped = wrap(phases(column, fringes)) + 2 * pi * turns
    absolute, residual, resolved = unwrapped(wrapped, [1e-6] * len(periods), fringes)
    assert resolved.all()
    np.testing.assert_allclose(absolute, phases(column, fringes)[-1], atol=2e-3, rtol=0)
    assert np.abs(residual).max() < 1e-2


def test_residual_is_the_inconsistency_of_the_worst_step():
    column = np.linspace(100, 500, 41)
    exact = phases(column, PAPER)
    for i, ratio in enumerate(PAPER.ratios[1:], start=1):
        for shift in (0.4, -0.4):
            shifted = exact.copy()
            shifted[i:] += shift  # this set and all after it
            shifted[i + 1 :] += np.cumprod(PAPER.ratios[i + 1 :])[:, None] * shift - shift
            _, residual, _ = unwrapped(wrap(shifted), [1e-3] * 4, PAPER)
            assert ratio * exact[i - 1] - shifted[i] == pytest.approx(-shift, abs=1e-9)
            np.testing.assert_allclose(residual, -shift, atol=1e-3)


@pytest.mark.parametrize("seed", range(3))
def test_noise_across_the_wrap_of_the_unit_frequency_never_gives_a_wrong_column(seed):
    """Pixels of the outermost columns, where noise carries the unit-frequency phase across 0 or 2π.

    At a noise of 8 DN on a modulation of 84 DN. With 10 000 pixels at an accepted probability of 1e-6 each, less than
    1 % of the seeds fail.
    """
    rng = np.random.default_rng(seed)
    sigma = np.sqrt(2 / np.array(PAPER.steps)) * 8 / 84  # rad
    column = np.concatenate([rng.uniform(-0.5, 10, 5_000), rng.uniform(598, 608, 5_000)])
    exact = phases(column, PAPER)
    noisy = exact + sigma[:, None] * rng.standard_normal(exact.shape)
    crossed = (noisy[0] < 0) | (noisy[0] >= 2 * pi)
    assert crossed.sum() > 500
    absolute, _, resolved = unwrapped(wrap(noisy), sigma**2, PAPER)
    assert np.abs(absolute - exact[-1])[resolved].max() < pi
    assert resolved[crossed].mean() > 0.3  # resolved, not merely discarded


def test_little_noise_leaves_nothing_unresolved_at_the_wrap():
    column = np.concatenate([np.linspace(-0.4, 10, 500), np.linspace(598, 607.4, 500)])
    for offset in (-0.05, 0.05):  # of the unit-frequency phase, rad
        shifted = phases(column, PAPER)
        shifted[0] += offset
        absolute, _, resolved = unwrapped(wrap(shifted), [2.5e-4] * 4, PAPER)
        assert resolved.all()
        np.testing.assert_allclose(absolute, phases(column, PAPER)[-1], atol=1e-3)


def test_two_equal_chains_stay_unresolved():
    """With whole ratios the first and the last half column cannot be told apart once noise reaches across."""
    fringes = FringeSet((600, 150, 30), (4, 4, 4))
    column = np.array([-0.45, 599.55])
    _, _, resolved = unwrapped(wrap(phases(column, fringes)), [0.01] * 3, fringes)
    assert not resolved.any()


def test_columns_just_beyond_the_field_never_come_out_at_its_other_end():
    """Their only possible chain is the wrong one, which the odds exclude."""
    column = np.concatenate([np.linspace(-7, -0.5, 200), np.linspace(607.5, 615, 200)])
    exact = phases(column, PAPER)
    absolute, _, resolved = unwrapped(wrap(exact), [2.5e-4] * 4, PAPER)
    np.testing.assert_allclose(absolute[resolved], exact[-1][resolved], atol=1e-3)
    assert not resolved[(column < -1.2) | (column > 608.2)].any()


@pytest.mark.parametrize("ratio", [2.0, 4.0, 8.0])
def test_safe_order_stops_where_its_error_probability_reaches_one_in_a_million(ratio):
    fringes = FringeSet((400, 400 / ratio), (4, 4))
    sigma = np.linspace(0.01, 0.3, 2000)
    probability = 2 * norm.sf(pi / np.sqrt(sigma**2 + ratio**2 * sigma**2))
    noise_only = np.exp(-1 / (2 * sigma**2))  # Rayleigh's tail at the modulation itself
    variance = Float((sigma**2).astype(np.float32))
    safe = np.array(order_is_safe([variance, variance], fringes))
    expected = (probability < 1e-6) & (noise_only < 1e-6)
    assert np.flatnonzero(safe)[-1] == pytest.approx(np.flatnonzero(expected)[-1], abs=1)
    assert safe[0]
    assert not safe[-1]
