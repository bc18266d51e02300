"""The bound of the phase, by closed forms, by another sum over probabilities, and by what the estimator reaches."""

import numpy as np
import pytest

from greenough.instrument.contract import CameraNoise
from greenough.pipeline.grey_variance import camera_variance
from greenough.pipeline.jit import Float
from greenough.pipeline.phase_bound import grey_information, phase_bound
from greenough.pipeline.phase_shifting import estimate_phasor, highest_harmonic

CAMERA = CameraNoise(full_well_e=6500.0, read_noise_e=10.0, electrons_per_dn=6500 / 251)
PIXELS = 60_000


def exact(noise: CameraNoise, quantised: bool, brightest: float):
    """`grey_information` over the range of grey values, interpolated."""
    light = np.linspace(0.02, brightest, 40)
    information = grey_information(light, noise, quantised)
    return lambda at: np.interp(at, light, information)


def test_white_noise_has_the_bound_of_the_n_step_formula():
    """sqrt(2 / N) σ / B, which eq. 2 reaches."""
    phase = np.linspace(0, 6, 7)
    for steps in (3, 4, 12):
        bound = phase_bound(np.full(7, 100.0), np.full(7, 70.0), phase, steps, lambda light: np.full(light.shape, 0.25))
        np.testing.assert_allclose(bound, 2 / steps * 4 / 70**2)


def test_shot_noise_alone_tells_the_reciprocal_of_its_variance():
    """A Poisson count of mean m has the information 1 / m; a little read noise takes what it adds to the variance."""
    camera = CameraNoise(full_well_e=6500.0, read_noise_e=0.5, electrons_per_dn=20.0)
    light = np.array([5.0, 20.0, 100.0])
    np.testing.assert_allclose(grey_information(light, camera, False), 400 / (20 * light + 0.25), rtol=2e-4)


def test_read_noise_alone_tells_the_reciprocal_of_its_variance():
    camera = CameraNoise(full_well_e=6500.0, read_noise_e=30.0, electrons_per_dn=20.0)
    light = np.array([0.005])
    np.testing.assert_allclose(grey_information(light, camera, False), 400 / (900 + 0.1), rtol=6e-3)


@pytest.mark.parametrize("quantised", [True, False])
def test_information_is_that_of_sampled_grey_values(quantised):
    """By the distance of Hellinger between the histograms for two neighbouring lights: J ≈ 4 Σ (√p - √q)² / (dI)².

    2 000 000 values each: chance, once its mean of 2 / (n dI²) a bin is taken off, leaves sqrt(8 / (n J)) / dI of
    it, 1.1 %. The lights' distance takes (dI / σ)² / 16, 0.8 %, away.
    """
    rng, light, step, n = np.random.default_rng(1), 8.0, 0.25, 2_000_000
    width = 1.0 if quantised else 0.15

    def histogram(level: float) -> np.ndarray:
        grey = (rng.poisson(level * CAMERA.electrons_per_dn, n) + rng.normal(0, 10, n)) / CAMERA.electrons_per_dn
        return np.histogram(grey, np.arange(2.0, 15, width) - 0.5)[0] / n

    below, above = histogram(light - step / 2), histogram(light + step / 2)
    seen = below + above > 1e-5
    found = 4 * np.sum((np.sqrt(above) - np.sqrt(below))[seen] ** 2) / step**2 - np.sum(seen) * 2 / n / step**2
    assert found == pytest.approx(grey_information(np.array([light]), CAMERA, quantised)[0], rel=0.05)


def test_more_noise_tells_less_and_rounding_takes_a_twelfth_of_its_variance():
    light = np.array([3.0, 20.0, 150.0])
    whole, fine = (grey_information(light, CAMERA, quantised) for quantised in (True, False))
    assert (whole < fine).all()
    for information, quantised in ((whole, True), (fine, False)):
        normal = 1 / camera_variance(CAMERA, quantised).at(light)
        assert (information > 0.997 * normal).all()
        np.testing.assert_allclose(information, normal, rtol=0.02)


def simulated(steps: int, background: float, modulation: float, quantised: bool, seed: int):
    """True phases, errors of the weighted estimator and its stated variances, (pixels,) each."""
    rng = np.random.default_rng(seed)
    true = rng.uniform(-np.pi, np.pi, PIXELS)
    angle = true + 2 * np.pi * np.arange(steps)[:, None] / steps
    light = (background + modulation * np.cos(angle)) * CAMERA.electrons_per_dn
    grey = (rng.poisson(light) + rng.normal(0, CAMERA.read_noise_e, light.shape)) / CAMERA.electrons_per_dn
    grey = np.rint(grey) if quantised else grey
    noise = camera_variance(CAMERA, quantised)
    variance = noise.at(grey.mean(axis=0)).astype(np.float32)
    phasor = estimate_phasor([Float(frame.astype(np.float32)) for frame in grey], Float(variance), Float(noise.per_dn))
    return true, np.angle(np.exp(1j * (np.array(phasor.phase) - true))), np.array(phasor.variance)


@pytest.mark.parametrize("quantised", [True, False])
@pytest.mark.parametrize(("background", "contrast"), [(88.0, 0.76), (100.0, 0.76), (106.0, 0.8)])
def test_twelve_steps_of_the_plane_are_within_5_percent_of_the_bound(background, contrast, quantised):
    """Of the Poisson-Gaussian bound, with the camera's rounding and without.

    60 000 pixels: a variance is known to 0.6 %.
    """
    modulation = contrast * background
    true, error, _ = simulated(12, background, modulation, quantised, int(background))
    information = exact(CAMERA, quantised, background + modulation)
    some = true[::20]
    bound = phase_bound(np.full(len(some), background), np.full(len(some), modulation), some, 12, information).mean()
    assert 0.97 < error.var() / bound <= 1.05


@pytest.mark.parametrize("steps", [3, 4, 5, 8, 12, 24])
def test_few_steps_miss_the_bound_by_the_harmonics_that_they_lack(steps):
    """`phase_shifting`: (1 - ρ^(2K+2)) / (1 - ρ^(2K)), which is exact where no harmonics alias."""
    background, modulation = 100.0, 80.0
    true, error, stated = simulated(steps, background, modulation, True, steps)
    some = true[::20]
    bound = phase_bound(
        np.full(len(some), background), np.full(len(some), modulation), some, steps,
        exact(CAMERA, True, background + modulation),
    ).mean()  # fmt: skip
    noise = camera_variance(CAMERA, True)
    g = noise.per_dn * modulation / (2 * noise.at(np.array(background)))
    rho, last = (1 - np.sqrt(1 - 4 * g**2)) / (2 * g), highest_harmonic(steps)
    excess = (1 - rho ** (2 * last + 2)) / (1 - rho ** (2 * last))
    print(f"{steps} steps: variance over the bound {error.var() / bound:.3f}, expected {excess:.3f}")
    assert error.var() / stated.mean() == pytest.approx(1, rel=0.03)
    if steps > 4:
        assert error.var() / bound == pytest.approx(excess, rel=0.035)
    else:
        assert 0.97 < error.var() / bound < 1.03 * excess
