from dataclasses import fields
from math import inf, pi

import numpy as np
import pytest

from greenough.instrument.contract import CameraNoise, Frames
from greenough.instrument.errors import InputError
from greenough.pipeline.decode import decode
from greenough.pipeline.fringes import PAPER, FringeSet
from greenough.pipeline.grey_variance import GreyVariance

NOISE = CameraNoise(full_well_e=6500.0, read_noise_e=10.0, electrons_per_dn=25.9)


def fringe_images(column, fringes, background, modulation):
    """Noise-free frames by eq. 1, (frames, *column.shape)."""
    return np.stack(
        [
            background + modulation * np.cos(2 * pi * column / period + 2 * pi * n / steps)
            for period, steps in zip(fringes.periods, fringes.steps, strict=True)
            for n in range(steps)
        ]
    )


def to_frames(stack, full_scale_dn=255.0, black_level_dn=4.0):
    count = len(stack)
    return Frames(
        stack=stack,
        full_scale_dn=full_scale_dn,
        black_level_dn=black_level_dn,
        exposure_us=1e4,
        gain_db=0.0,
        stage_position_mm=0.0,
        serials=np.arange(count),
        times_s=np.arange(count, dtype=float),
    )


def quantised(values):
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


def photographed(light, rng):
    """What the camera of ``NOISE`` makes of DN above black: shot noise, read noise, black level 4, 8 bits."""
    electrons = rng.poisson(light * NOISE.electrons_per_dn) + rng.normal(0, NOISE.read_noise_e, light.shape)
    return quantised(electrons / NOISE.electrons_per_dn + 4)


@pytest.mark.parametrize("noise_dn", [1, 3, 5, 8])
def test_full_frames_decode_without_order_errors_at_the_noise_of_the_bound(noise_dn):
    """Of noise that is the same everywhere, sqrt(2/N) σ / B, with the 1/12 DN² of rounding added to σ²."""
    rng = np.random.default_rng(noise_dn)
    column = np.linspace(0, 608, 1280, endpoint=False)
    images = fringe_images(column, PAPER, 118, 84).astype(np.float32)
    stack = np.stack(
        [quantised(image + noise_dn * rng.standard_normal((960, 1280), dtype=np.float32)) for image in images]
    )
    phase_map = decode(stack, PAPER)
    error = (phase_map.absolute - 2 * pi * column / 12)[phase_map.valid]
    assert np.count_nonzero(np.abs(error) > pi) == 0
    assert phase_map.valid.mean() >= 0.98
    assert error.std() <= 1.05 * np.sqrt(2 / 12) * noise_dn / 84
    bound = np.sqrt(2 / 12) * np.sqrt(noise_dn**2 + 1 / 12) / 84
    assert error.std() == pytest.approx(bound, rel=0.005)  # 5 standard deviations of the estimate are 0.0033
    assert abs(error.mean()) < 1e-3


@pytest.mark.parametrize(
    ("kind", "scale"), [(np.uint8, 1), (np.uint16, 257), (np.float32, 1), (np.float64, 1)], ids=lambda v: str(v)
)
def test_every_type_of_frame_gives_phase_modulation_and_background(kind, scale):
    column = np.broadcast_to(np.linspace(0, 607, 300), (7, 300))
    images = scale * fringe_images(column, PAPER, 100, 60)
    stack = (np.rint(images) if np.dtype(kind).kind == "u" else images).astype(kind)
    phase_map = decode(stack, PAPER)
    assert phase_map.valid.all()
    rounding = 0.5 if np.dtype(kind).kind == "u" else 1e-3
    np.testing.assert_allclose(phase_map.absolute, 2 * pi * column / 12, atol=2 * rounding / (60 * scale) + 1e-4)
    np.testing.assert_allclose(phase_map.modulation, 60 * scale, atol=2 * rounding)
    np.testing.assert_allclose(phase_map.background, 100 * scale, atol=rounding + 1e-6 * 100 * scale)


def by_float64(stack, fringes, noise, black_dn):
    """Phase, modulation, background and sigma by the formulas of `phase_shifting` in double precision.

    Eq. 5 follows the coarsest set's phase from 0 to 2π: for columns that are not next to its wrap.
    """
    above = stack.astype(np.float64) - black_dn
    background = above.mean(axis=0)
    per_dn = 1 / noise.electrons_per_dn
    variance = (noise.read_noise_e * per_dn) ** 2 + 1 / 12 + per_dn * background
    absolute = 0.0
    for part, steps, ratio in zip(fringes.slices, fringes.steps, fringes.ratios, strict=True):
        last = max(1, steps // 2 - 1)
        turns = np.exp(-2j * pi * np.outer(np.arange(1, last + 1), np.arange(steps)) / steps)
        harmonics = 2 / steps * np.tensordot(turns, above[part], axes=1)
        turn = np.conj(harmonics[0]) / np.abs(harmonics[0])
        g = per_dn * np.abs(harmonics[0]) / (2 * variance)
        share, phasor = 0.0, harmonics[-1]
        for harmonic in harmonics[-2::-1]:
            share = g / (1 - g * share)
            phasor = harmonic - share * turn * phasor
        phase, expected = np.angle(phasor), ratio * absolute
        absolute = phase + 2 * pi * np.rint((expected - phase) / (2 * pi)) if np.ndim(absolute) else phase % (2 * pi)
    sigma = np.sqrt(2 / steps * variance * (1 - g * share)) / np.abs(phasor)
    return absolute, np.abs(phasor), background, sigma


@pytest.mark.parametrize("fringes", [PAPER, FringeSet((608, 100, 16.5), (5, 9, 7))], ids=["paper", "odd steps"])
def test_single_precision_is_as_good_as_double(fringes):
    """A phase of 300 rad has a last digit of 3e-5 rad; the finest fringes have some 6 rad per mm of height."""
    column = np.linspace(60, 550, 40 * 51).reshape(40, 51)
    light = fringe_images(column, fringes, np.linspace(40, 120, 51), np.linspace(30, 100, 51))
    stack = photographed(light, np.random.default_rng(2))
    phase_map = decode(to_frames(stack), fringes, NOISE)
    absolute, modulation, background, sigma = by_float64(stack, fringes, NOISE, 4.0)
    assert phase_map.valid.all()
    assert np.abs(phase_map.absolute - absolute).max() < 5e-5
    np.testing.assert_allclose(phase_map.modulation, modulation, rtol=2e-6)
    np.testing.assert_allclose(phase_map.background, background, rtol=1e-6)
    np.testing.assert_allclose(phase_map.sigma, sigma, rtol=3e-6)


def test_a_phase_map_stays_as_it_is_when_others_are_made_and_its_frames_are_overwritten():
    column = np.broadcast_to(np.linspace(20, 580, 100), (10, 100))
    stack = quantised(fringe_images(column, PAPER, 118, 84))
    first = decode(stack, PAPER)
    kept = {field.name: np.copy(getattr(first, field.name)) for field in fields(first)}
    stack[...] = quantised(fringe_images(608 - column, PAPER, 100, 60))
    for _ in range(3):
        decode(stack, PAPER)
    for name, values in kept.items():
        np.testing.assert_array_equal(getattr(first, name), values)


def test_one_set_alone_decodes_over_its_period():
    fringes = FringeSet((300.0,), (8,))
    column = np.broadcast_to(np.linspace(15, 285, 100), (4, 100))
    phase_map = decode(quantised(fringe_images(column, fringes, 118, 84)), fringes, NOISE)
    assert phase_map.valid.all()
    np.testing.assert_allclose(phase_map.absolute, 2 * pi * column / 300, atol=0.01)
    np.testing.assert_array_equal(phase_map.residual, np.zeros((4, 100)))


def test_other_sets_and_non_integer_periods_decode():
    fringes = FringeSet((512.0, 70.5, 21.3), (3, 5, 8))
    column = np.broadcast_to(np.linspace(0, 511, 400), (5, 400))
    phase_map = decode(fringe_images(column, fringes, 100, 60).astype(np.float32), fringes)
    assert phase_map.valid.all()
    np.testing.assert_allclose(phase_map.absolute, 2 * pi * column / 21.3, atol=1e-3)


def test_background_is_above_black_and_sigma_is_what_is_observed():
    """With shot noise, on a bright and a dark half."""
    rng = np.random.default_rng(3)
    rows, cols = 200, 600
    column = np.broadcast_to(np.linspace(20, 580, cols), (rows, cols))
    level = np.where(np.arange(rows)[:, None] < rows // 2, 110.0, 25.0)
    frames = to_frames(photographed(fringe_images(column, PAPER, level, 0.7 * level), rng))
    for noise in (NOISE, None):
        phase_map = decode(frames, PAPER, noise)
        assert phase_map.valid.all()
        for half in (slice(None, rows // 2), slice(rows // 2, None)):
            error = (phase_map.absolute - 2 * pi * column / 12)[half]
            # 60 000 pixels: 4.5 standard deviations of their standard deviation are 1.3 %.
            assert error.std() == pytest.approx(np.median(phase_map.sigma[half]), rel=0.02)
            assert phase_map.background[half].mean() == pytest.approx(level[half].mean(), abs=0.02)


def test_dark_and_unmodulated_pixels_are_invalid():
    """120 000 pixels without fringes, at an accepted probability of less than 1e-6 each."""
    rng = np.random.default_rng(5)
    column = np.broadcast_to(np.linspace(20, 580, 400), (600, 400))
    level = np.zeros((600, 1))
    level[:150] = 90.0  # lit with fringes
    level[450:] = 90.0  # lit without fringes
    modulation = np.where(np.arange(600)[:, None] < 150, 60.0, 0.0)
    stack = photographed(fringe_images(column, PAPER, level, modulation), rng)
    for noise in (NOISE, None):
        valid = decode(to_frames(stack), PAPER, noise).valid
        assert valid[:150].all()
        assert not valid[150:].any()


def test_weak_modulation_is_valid_without_errors_or_invalid():
    rng = np.random.default_rng(6)
    column = np.broadcast_to(rng.uniform(20, 580, (400, 1)), (400, 500))
    modulation = np.linspace(0, 12, 500)
    stack = photographed(fringe_images(column, PAPER, 20.0, modulation), rng)
    phase_map = decode(to_frames(stack), PAPER, NOISE)
    error = np.abs(phase_map.absolute - 2 * pi * column / 12)
    assert np.nanmax(error) < pi
    share = phase_map.valid.mean(axis=0)
    # σ² = 20 / 25.9 + (10 / 25.9)² + 1/12, so that s = 2.92 σ / B <= π / 5.1 wherever B is above 4.8 DN.
    assert share[modulation < 3].max() < 0.01
    assert share[modulation > 8].min() > 0.99


def test_saturated_pixels_are_invalid():
    column = np.broadcast_to(np.linspace(20, 580, 100), (10, 100))
    stack = quantised(fringe_images(column, PAPER, 118, 84))
    stack[7, 3, 5] = 255
    valid = decode(stack, PAPER).valid
    assert not valid[3, 5]
    assert valid.sum() == valid.size - 1
    merged = stack.astype(np.float32)
    merged[:, 3, 5] = inf
    assert not decode(merged, PAPER).valid[3, 5]
    lower_clip = to_frames(stack, full_scale_dn=201.0)
    assert not decode(lower_clip, PAPER).valid[stack.max(axis=0) >= 201].any()


def test_an_order_that_the_sets_do_not_agree_on_is_invalid():
    """A pixel that sees two columns: each set sees another mixture, as at an edge."""
    column = np.broadcast_to(np.linspace(20, 500, 200), (3, 200))
    stack = fringe_images(column, PAPER, 100, 60)
    stack[PAPER.slices[2]] = fringe_images(column + 19, PAPER, 100, 60)[PAPER.slices[2]]  # off by almost half a period
    phase_map = decode(stack.astype(np.float32), PAPER, NOISE)
    assert not phase_map.valid.any()
    assert np.isnan(phase_map.absolute).all()


def test_variance_per_pixel_is_used_as_given():
    column = np.broadcast_to(np.linspace(20, 580, 100), (10, 100))
    stack = fringe_images(column, PAPER, 118, 84).astype(np.float32)
    variance = np.full((10, 100), 4.0)
    variance[5:] = 400.0
    phase_map = decode(stack, PAPER, GreyVariance(variance, 0.0))
    np.testing.assert_allclose(phase_map.sigma, np.sqrt(2 / 12 * variance) / 84, rtol=1e-4)
    assert phase_map.valid[:5].all()
    assert not phase_map.valid[5:].any()
    with pytest.raises(InputError, match=r"\(5, 100\).*\(10, 100\)"):
        decode(stack, PAPER, GreyVariance(0.0, variance[5:]))


@pytest.mark.parametrize(
    ("stack", "says"),
    [
        (np.zeros((23, 4, 4), np.uint8), "23 frames .* needs 24"),
        (np.zeros((24, 4), np.uint8), r"\(frames, rows, cols\)"),
        (np.zeros((24, 0, 4), np.uint8), "none of them 0"),
        (np.zeros((24, 4, 4), np.int32), "int32"),
        (np.zeros((24, 4, 4), bool), "bool"),
    ],
)
def test_a_stack_that_does_not_fit_is_refused(stack, says):
    with pytest.raises(InputError, match=says):
        decode(stack, PAPER)
    with pytest.raises(InputError, match=says):
        decode(to_frames(stack), PAPER)


def test_sets_without_redundancy_decode_with_the_assumed_noise():
    fringes = FringeSet((300, 60), (3, 3))
    column = np.broadcast_to(np.linspace(5, 290, 100), (10, 100))
    phase_map = decode(quantised(fringe_images(column, fringes, 118, 84)), fringes)
    assert phase_map.valid.all()
    # 1 % of the largest grey value, 202 DN
    np.testing.assert_allclose(phase_map.sigma, np.sqrt(2 / 3) * np.hypot(2.02, np.sqrt(1 / 12)) / 84, rtol=0.02)
