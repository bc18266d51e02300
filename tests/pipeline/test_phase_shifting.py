from math import pi

import numpy as np
import pytest
from scipy.stats import norm, poisson

from greenough.pipeline.jit import Float
from greenough.pipeline.phase_shifting import estimate_phasor, highest_harmonic

PER_DN_E, READ_E, BLACK_DN = 25.9, 10.0, 4.0
AT_BLACK_DN2, VARIANCE_PER_DN = (READ_E / PER_DN_E) ** 2 + 1 / 12, 1 / PER_DN_E
PIXELS = 120_000


def angles(phase, steps):
    """(steps, pixels)."""
    return phase + 2 * pi * np.arange(steps)[:, None] / steps


def estimated(stack, per_dn=VARIANCE_PER_DN, at_black=AT_BLACK_DN2):
    """Phase, modulation and sigma of frames (steps, pixels) above ``BLACK_DN``, as NumPy arrays."""
    variance = at_black + per_dn * np.maximum(stack.mean(axis=0) - BLACK_DN, 0)
    grey = [Float(frame.astype(np.float32)) for frame in stack]
    phasor = estimate_phasor(grey, Float(variance.astype(np.float32)), Float(per_dn))
    return np.array(phasor.phase), np.array(phasor.modulation), np.sqrt(np.array(phasor.variance))


def by_equation_2(stack):
    phasor = 2 / len(stack) * (stack * np.exp(-1j * angles(np.zeros(1), len(stack)))).sum(axis=0)
    return np.angle(phasor), np.abs(phasor)


def wrapped(difference):
    return np.angle(np.exp(1j * difference))


def information(light_dn):
    """Fisher information on the light, DN^-2, in one grey value of the camera: from its exact probabilities."""
    mean = light_dn * PER_DN_E
    electrons = np.arange(max(0, int(mean - 9 * np.sqrt(mean))), int(mean + 9 * np.sqrt(mean) + 20))
    chance = poisson.pmf(electrons, mean)
    change = chance * (electrons / mean - 1) * PER_DN_E
    reach = 7 * READ_E
    grey = np.arange(np.floor((electrons[0] - reach) / PER_DN_E), np.ceil((electrons[-1] + reach) / PER_DN_E) + 1)
    edges = norm.cdf(((np.append(grey, grey[-1] + 1) - 0.5)[:, None] * PER_DN_E - electrons) / READ_E)
    rounded = np.diff(edges, axis=0)  # (grey values, electrons)
    likely = rounded @ chance > 1e-13
    return float(((rounded @ change)[likely] ** 2 / (rounded @ chance)[likely]).sum())


def bounds(background, modulation, steps):
    """Cramér-Rao bounds of the variances of φ and of B / B, with A, B and φ unknown, averaged over the phase."""
    light = np.linspace(background - modulation, background + modulation, 30)
    angle = angles(np.linspace(0, 2 * pi / steps, 20, endpoint=False), steps)
    known = np.interp(background + modulation * np.cos(angle), light, [information(level) for level in light])
    slope = np.stack([np.ones_like(angle), np.cos(angle), -modulation * np.sin(angle)])
    bound = np.linalg.inv(np.einsum("np,inp,jnp->pij", known, slope, slope)).mean(axis=0)
    return bound[2, 2], bound[1, 1] / modulation**2


@pytest.mark.parametrize(
    ("steps", "background", "contrast"),
    [(12, 20, 0.8), (12, 110, 0.3), (12, 110, 0.8), (12, 60, 0.98), (8, 110, 0.8), (6, 110, 0.8), (6, 20, 0.95)],
)
def test_phase_and_modulation_come_as_near_to_the_bound_as_their_harmonics_allow(steps, background, contrast):
    """Against the Fisher information of a Poisson, normal and rounded grey value, summed up numerically.

    120 000 pixels: 4.5 standard deviations of a standard deviation are 0.92 %, of a variance 1.84 %.
    """
    rng = np.random.default_rng(steps * background)
    modulation = contrast * background
    true = rng.uniform(-pi, pi, PIXELS)
    light = background + modulation * np.cos(angles(true, steps))
    read = rng.normal(0, READ_E, light.shape)
    phase, found, sigma = estimated(np.rint((rng.poisson(light * PER_DN_E) + read) / PER_DN_E + BLACK_DN))
    error = wrapped(phase - true)

    correlation = modulation / PER_DN_E / 2 / (AT_BLACK_DN2 + background / PER_DN_E)
    rho, last = (1 - np.sqrt(1 - 4 * correlation**2)) / (2 * correlation), highest_harmonic(steps)
    excess = (1 - rho ** (2 * last + 2)) / (1 - rho ** (2 * last))
    assert excess < {12: 1.01, 8: 1.02, 6: 1.06}[steps]
    for scatter, bound in zip((error, found / modulation), bounds(background, modulation, steps), strict=True):
        # The bound itself is up to 1 % lower than that of normal noise with the same variance.
        assert 0.98 * bound < scatter.var() < 1.03 * excess * bound
    assert np.sqrt(np.mean(sigma**2)) == pytest.approx(error.std(), rel=0.01)
    assert np.sqrt(np.mean(sigma**2)) == pytest.approx((found / modulation).std(), rel=0.015)

    part = (true * steps / (2 * pi) % 1 * 16).astype(int)  # of the phase between two frames
    bias = np.array([error[part == k].mean() for k in range(16)])
    assert np.abs(bias).max() < 5 * error.std() / np.sqrt(PIXELS / 16)


@pytest.mark.parametrize("steps", [3, 4, 5])
def test_up_to_five_steps_are_decoded_by_equation_2(steps):
    stack = np.random.default_rng(steps).uniform(10, 250, (steps, 1000))
    for result, expected in zip(estimated(stack), by_equation_2(stack), strict=False):
        np.testing.assert_allclose(result, expected, atol=1e-3)


def test_noise_that_does_not_grow_with_the_light_weights_nothing():
    stack = np.random.default_rng(1).uniform(10, 250, (12, 1000))
    phase, modulation = by_equation_2(stack)
    result, found, sigma = estimated(stack, per_dn=0.0, at_black=4.0)
    np.testing.assert_allclose(wrapped(result - phase), 0, atol=1e-4)
    np.testing.assert_allclose(found, modulation, atol=1e-3)
    np.testing.assert_allclose(sigma, np.sqrt(2 / 12 * 4) / modulation, rtol=1e-4)


@pytest.mark.parametrize("steps", [6, 8, 12])
@pytest.mark.parametrize("background", [20.0, 100.0])
def test_harmonics_in_phase_do_no_harm_unless_they_alias(steps, background):
    true = np.linspace(-pi, pi, 700)
    angle = angles(true, steps)
    fringes = BLACK_DN + background * (1 + 0.7 * np.cos(angle))
    aliases = steps - highest_harmonic(steps)
    for order in range(2, aliases):
        phase, *_ = estimated(fringes + 0.05 * background * np.cos(order * angle))
        np.testing.assert_allclose(wrapped(phase - true), 0, atol=1e-5)
    phase, *_ = estimated(fringes + 0.05 * background * np.cos(aliases * angle))
    assert np.abs(wrapped(phase - true)).max() > 1e-4


@pytest.mark.parametrize("contrast", [0.8, 0.95])
@pytest.mark.parametrize("gamma", [1.1, 1.4, 1.8, 2.2])
def test_a_projectors_gamma_turns_the_phase_of_twelve_steps_by_less_than_a_third_of_a_milliradian(gamma, contrast):
    """Also by equation 2 its fine harmonics alias; the weights let more of them in."""
    true = np.linspace(-pi, pi, 700)
    harmonic = np.fft.rfft((0.5 + 0.5 * np.cos(2 * pi * np.arange(4096) / 4096)) ** gamma).real
    harmonic *= contrast * 100 / harmonic[1]
    light = 100 + sum(harmonic[k] * np.cos(k * angles(true, 12)) for k in range(1, 200))
    phase, *_ = estimated(light + BLACK_DN)
    plain, _ = by_equation_2(light)
    assert np.abs(wrapped(plain - true)).max() < 5e-5
    assert np.abs(wrapped(phase - true)).max() < 3.3e-4


def test_of_a_second_harmonic_out_of_phase_the_share_of_the_weights_passes():
    """With many steps that share is (1 - sqrt(1 - 4 g²)) / (2 g), g = b B / (2 V)."""
    true = np.linspace(-pi, pi, 700)
    angle = angles(true, 24)
    phase, *_ = estimated(BLACK_DN + 100 + 80 * np.cos(angle) + 0.8 * np.sin(2 * angle))
    g = 80 / PER_DN_E / 2 / (AT_BLACK_DN2 + 100 / PER_DN_E)
    np.testing.assert_allclose(wrapped(phase - true), 0.01 * (1 - np.sqrt(1 - 4 * g**2)) / (2 * g), rtol=0.03)


def test_perfect_frames_without_light_or_noise_give_numbers():
    phase, modulation, _ = estimated(np.full((12, 5), BLACK_DN), per_dn=0.0, at_black=0.0)
    assert np.isfinite(phase).all()
    np.testing.assert_allclose(modulation, 0, atol=1e-5)
