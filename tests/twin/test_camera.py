"""Claims about the camera's noise chain. Chance refuses a sound camera in one run out of a million per test."""

from itertools import combinations

import numpy as np
import pytest
from scipy.stats import chi2, kstest, norm, skew

from greenough.instrument.rigfile import CameraSection, load_rig_file
from greenough.twin.camera import Sensor, build_sensor, expose, poisson
from greenough.twin.renderer import dr, mi
from greenough.twin.settings import CameraSettings

FALSE_ALARM = 1e-6
SHAPE = (180, 250)
QUIET = CameraSettings(shot_noise=False, read_noise_e=0, prnu=0, dsnu_e=0)
TEMPORAL = CameraSettings(shot_noise=True, read_noise_e=10, prnu=0, dsnu_e=0)


def section(bits: int = 0, *overrides: str) -> CameraSection:
    size = [f"camera.rows={SHAPE[0]}", f"camera.cols={SHAPE[1]}"]
    return load_rig_file("twin", [*size, f"camera.bits={bits}", *overrides]).camera


def sensor(settings: CameraSettings, bits: int = 0, seed: int = 1) -> Sensor:
    return build_sensor(section(bits), settings, seed)


def frames(level_e: float, n: int, of: Sensor, seed: int = 1, run: str = "run", serial: int = 0) -> np.ndarray:
    """``n`` frames of an even light, (n, rows, cols) as the camera gives them."""
    even = dr.full(mi.Float, level_e, SHAPE[0] * SHAPE[1])
    return expose([even] * n, of, seed, run, serial)


def electrons(stack: np.ndarray, of: Sensor) -> np.ndarray:
    return (stack.astype(float) - of.section.black_level_dn) * of.section.noise.electrons_per_dn


def assert_mean(values: np.ndarray, mean: float, variance: float, tests: int = 1) -> None:
    z = (values.mean() - mean) / np.sqrt(variance / values.size)
    assert abs(z) < norm.isf(FALSE_ALARM / tests / 2)


def assert_variance(values: np.ndarray, variance: float, tests: int = 1) -> None:
    """Of normal ``values`` with a mean that is estimated."""
    low, high = chi2.ppf([FALSE_ALARM / tests / 2, 1 - FALSE_ALARM / tests / 2], values.size - 1)
    assert low < values.var() * values.size / variance < high


def test_without_noise_grey_values_are_the_light_on_top_of_the_black_level():
    camera = sensor(QUIET)
    for level in (0.0, 100.0, 3000.0, 6500.0):
        grey = frames(level, 1, camera)
        np.testing.assert_allclose(grey, 4 + level * 251 / 6500, rtol=1e-6)


def test_one_noise_is_the_same_whether_the_other_is_on_or_off():
    both, shot, read, none = (
        frames(900.0, 1, sensor(CameraSettings(shot_noise=s, read_noise_e=r, prnu=0, dsnu_e=0)))
        for s, r in ((True, 10), (True, 0), (False, 10), (False, 0))
    )
    assert np.std(shot - none) > 0.5
    assert np.std(read - none) > 0.2
    np.testing.assert_allclose(both - shot, read - none, atol=1e-4)


@pytest.mark.parametrize("level_e", [0.0, 60.0, 900.0, 6000.0])
def test_temporal_noise_is_shot_and_read_noise(level_e):
    camera = sensor(TEMPORAL)
    seen = electrons(frames(level_e, 8, camera), camera)
    # The 0.05 electrons that the photon counts keep in the dark, and 0.02 of their variance, are within the bounds'
    # resolution: 10 electrons / sqrt(360000 values) = 0.017, to which the bias is added.
    bias = 0.05 if level_e == 0 else 0.0
    assert_mean(seen - bias, level_e, level_e + 100, tests=4)
    assert_variance(seen, level_e + 100, tests=4)


def test_a_photon_transfer_curve_gives_back_the_data_sheet():
    """EMVA 1288: half the variance of the difference of two frames over their mean, free of fixed patterns."""
    camera = sensor(CameraSettings())
    levels = np.array([0.0, 500.0, 1500.0, 3000.0, 6000.0])
    first = np.stack([frames(level, 1, camera, serial=k) for k, level in enumerate(levels)])
    second = np.stack([frames(level, 1, camera, serial=100 + k) for k, level in enumerate(levels)])
    for level, difference in zip(levels, (first - second).astype(float), strict=True):
        expected = 2 * (level + 10.0**2) / camera.section.noise.electrons_per_dn**2
        assert_variance(difference, expected, tests=len(levels))


def test_pixels_differ_in_responsivity_by_the_prnu():
    camera = sensor(CameraSettings(shot_noise=False, read_noise_e=0, prnu=0.01, dsnu_e=0))
    seen = electrons(frames(3000.0, 1, camera), camera) / 3000
    assert_variance(seen, 0.01**2, tests=2)
    assert_mean(seen, 1, 0.01**2, tests=2)


def test_under_noise_frames_share_their_fixed_pattern_and_nothing_else():
    """EMVA 1288: the covariance of two frames over the pixels is that of responsivity and dark signal."""
    camera = sensor(CameraSettings())
    first, second = electrons(frames(3000.0, 2, camera), camera)
    covariance = np.mean((first - first.mean()) * (second - second.mean()))
    fixed = (0.01 * 3000) ** 2 + 3.0**2
    noise = 3000 + 10.0**2
    spread = np.sqrt(((fixed + noise) ** 2 + fixed**2) / first.size)
    assert abs(covariance - fixed) < norm.isf(FALSE_ALARM / 2) * spread


def test_pixels_differ_in_the_dark_by_the_dsnu():
    camera = sensor(CameraSettings(shot_noise=False, read_noise_e=0, prnu=0, dsnu_e=3))
    for level in (0.0, 3000.0):  # an offset: the same at any light
        seen = electrons(frames(level, 1, camera), camera)
        assert_variance(seen, 3.0**2, tests=4)
        assert_mean(seen, level, 3.0**2, tests=4)


def test_the_fixed_pattern_belongs_to_the_sensor_and_not_to_the_exposure():
    fixed = CameraSettings(shot_noise=False, read_noise_e=0)
    one = frames(3000.0, 1, sensor(fixed), run="a")
    np.testing.assert_array_equal(one, frames(3000.0, 1, sensor(fixed), run="b", serial=7))
    other = frames(3000.0, 1, sensor(fixed, seed=2), run="a")
    r = np.corrcoef(one.ravel(), other.ravel())[0, 1]
    assert abs(r) * np.sqrt(one.size) < norm.isf(FALSE_ALARM / 2)


def test_read_noise_is_normal():
    camera = sensor(CameraSettings(shot_noise=False, read_noise_e=10, prnu=0, dsnu_e=0))
    seen = electrons(frames(1000.0, 1, camera), camera)
    assert kstest((seen.ravel() - 1000) / 10, "norm").pvalue > FALSE_ALARM


def test_quantisation_rounds_to_whole_grey_values_and_adds_their_variance():
    camera = sensor(TEMPORAL, bits=8)
    stack = frames(3000.0, 8, camera)
    assert stack.dtype == np.uint8
    seen = electrons(stack, camera)
    # Noise of two grey values makes the rounding error uniform and independent.
    rounding = camera.section.noise.electrons_per_dn**2 / 12
    assert_mean(seen, 3000, 3100 + rounding, tests=2)
    assert_variance(seen, 3100 + rounding, tests=2)


@pytest.mark.parametrize(("bits", "dtype", "full_scale"), [(8, np.uint8, 255), (16, np.uint16, 65535)])
def test_a_full_well_is_full_scale_and_more_light_is_cut_off(bits, dtype, full_scale):
    for level in (6500.0, 20_000.0):
        stack = frames(level, 2, sensor(QUIET, bits))
        assert stack.dtype == dtype
        assert stack.shape == (2, *SHAPE)
        assert (stack == full_scale).all()
    almost = frames(6500.0 * (1 - 1 / full_scale), 1, sensor(QUIET, bits))
    assert (almost < full_scale).all()


def test_whole_grey_values_are_the_nearest():
    camera = sensor(QUIET, bits=8)
    per_dn = camera.section.noise.electrons_per_dn
    for grey in (4.0, 57.4, 57.6, 200.45):
        assert (frames((grey - 4) * per_dn, 1, camera) == round(grey)).all()


def test_dark_noise_is_cut_off_at_zero():
    low = build_sensor(section(8, "camera.black_level_dn=0.0"), TEMPORAL, 1)
    stack = frames(0.0, 1, low)
    # Half of the pixels would be below zero. Grey value 1 needs half a grey value of electrons.
    half = norm.cdf(0.5 * low.section.noise.electrons_per_dn / 10)
    share = (stack == 0).mean()
    assert abs(share - half) < 0.01
    assert stack.max() < 5


def test_float_frames_are_neither_rounded_nor_cut_off():
    camera = sensor(CameraSettings(read_noise_e=200))
    assert camera.full_scale_dn == float("inf")
    bright, dark = frames(20_000.0, 1, camera), frames(0.0, 1, camera)
    assert bright.dtype == np.float32
    assert bright.mean() > 700
    assert dark.min() < 0
    assert not np.isin(bright % 1, 0).all()


@pytest.mark.parametrize("mean", [0.5, 1.0, 2.0, 5.0, 20.0, 100.0, 1000.0, 6500.0])
def test_photon_counts_have_the_mean_variance_and_skewness_of_poissons(mean):
    # The quantile function over evenly spaced probabilities: no chance involved.
    n = 1_000_000
    normal = mi.Float(norm.ppf((np.arange(n) + 0.5) / n).astype(np.float32))
    counts = np.array(poisson(dr.full(mi.Float, mean, n), normal), float)
    assert (counts == np.round(counts)).all()
    assert counts.min() >= 0
    assert counts.mean() == pytest.approx(mean, abs=0.02)
    assert counts.var() == pytest.approx(mean, abs=0.02)
    assert skew(counts) == pytest.approx(mean**-0.5, abs=0.05)


def test_an_exposure_is_the_same_whoever_takes_it_and_whenever():
    camera = sensor(CameraSettings(), bits=8)
    stack = frames(2000.0, 5, camera, run="a", serial=10)
    np.testing.assert_array_equal(stack, frames(2000.0, 5, camera, run="a", serial=10))
    np.testing.assert_array_equal(stack[3:], frames(2000.0, 2, camera, run="a", serial=13))


def test_no_two_exposures_share_noise():
    """All shifts of one frame against another, for every pair: a stream used twice would show at some shift."""
    camera = sensor(TEMPORAL)
    keys = [(seed, run, serial) for seed in (1, 2) for run in ("calibrate", "measure") for serial in (0, 1, 24)]
    stack = np.stack([frames(3000.0, 1, camera, *key)[0] for key in keys]).astype(float)
    noise = (stack - stack.mean(axis=(1, 2), keepdims=True)) / stack.std(axis=(1, 2), keepdims=True)
    spectra = np.fft.rfft(noise.reshape(len(keys), -1), axis=1)
    n = noise[0].size
    pairs = list(combinations(range(len(keys)), 2))
    limit = norm.isf(FALSE_ALARM / (n * len(pairs)) / 2) / np.sqrt(n)
    for a, b in pairs:
        correlation = np.fft.irfft(spectra[a].conj() * spectra[b], n) / n
        assert np.abs(correlation).max() < limit
    # The same search finds a stream that was used twice, shifted by some pixels.
    again = np.fft.rfft(np.roll(noise[0].ravel(), 1234))
    assert np.fft.irfft(spectra[0].conj() * again, n).argmax() == 1234


def test_noise_is_white_over_the_frame():
    camera = sensor(TEMPORAL)
    image = frames(3000.0, 1, camera)[0].astype(float)
    noise = (image - image.mean()) / image.std()
    n = noise.size
    correlation = np.fft.irfft2(np.abs(np.fft.rfft2(noise)) ** 2, SHAPE) / n
    correlation[0, 0] = 0
    assert np.abs(correlation).max() < norm.isf(FALSE_ALARM / n / 2) / np.sqrt(n)
