from dataclasses import dataclass, field
from math import inf, pi
from typing import Any

import numpy as np
import pytest

from greenough.instrument.contract import CameraNoise, Frames, Procedure
from greenough.instrument.errors import InputError
from greenough.instrument.frame_figures import BRIGHTEST_PERCENTILE
from greenough.pipeline.decode import decode
from greenough.pipeline.exposure import auto_exposure, capture_bracketed, merge
from greenough.pipeline.fringes import PAPER
from greenough.pipeline.grey_variance import camera_variance

NOISE = CameraNoise(full_well_e=6500.0, read_noise_e=10.0, electrons_per_dn=25.9)
BLACK_DN, FULL_SCALE_DN = 4.0, 255.0


def exposed(light, exposure_us, rng, full_scale_dn=FULL_SCALE_DN):
    """Frames of a camera with the noise of ``NOISE``; ``light`` is in DN per ms, (frames, rows, cols)."""
    mean_e = light * exposure_us / 1e3 * NOISE.electrons_per_dn
    grey = (rng.poisson(mean_e) + rng.normal(0, NOISE.read_noise_e, light.shape)) / NOISE.electrons_per_dn + BLACK_DN
    stack = (
        grey.astype(np.float32) if full_scale_dn == inf else np.clip(np.rint(grey), 0, full_scale_dn).astype(np.uint8)
    )
    count = len(light)
    return Frames(stack, full_scale_dn, BLACK_DN, exposure_us, 0.0, 0.0, np.arange(count), np.zeros(count))


@dataclass
class FakeRig:
    """A camera that looks at ``light`` DN per ms, (rows, cols), times the pattern's mean over 255."""

    light: np.ndarray
    exposure_us: float = 1e4
    exposure_limits_us: tuple[float, float] = (8e3, 5e6)
    full_scale_dn: float = FULL_SCALE_DN
    shape: tuple[int, int] = (6, 608)
    captures: list[float] = field(default_factory=list)
    procedure: Procedure = field(
        default_factory=lambda: Procedure(PAPER.periods, PAPER.steps, 16, 30, 0.1, exposure_share=0.8)
    )
    black_level_dn = BLACK_DN
    noise = NOISE

    def __post_init__(self):
        self.rng = np.random.default_rng(1)
        self.camera = self.projector = self

    def capture(self, patterns):
        self.captures.append(self.exposure_us)
        light = self.light * patterns.mean(axis=(1, 2))[:, None, None] / 255
        return exposed(light, self.exposure_us, self.rng, self.full_scale_dn)


def rig_with(light, **settings) -> Any:
    """The part of a rig that exposures need."""
    return FakeRig(light, **settings)


def board(level, shape=(100, 200)):
    """Dark, with 2.5 % of it at ``level``."""
    light = np.full(shape, 0.1 * level)
    light[: shape[0] // 20, : shape[1] // 2] = level
    return light


@pytest.mark.parametrize("level", [0.05, 0.5, 5.0, 20.0])
@pytest.mark.parametrize("start_us", [8e3, 1e4, 5e6])
@pytest.mark.parametrize("full_scale_dn", [FULL_SCALE_DN, inf])
def test_the_brightest_part_reaches_the_share_of_full_scale(level, start_us, full_scale_dn):
    rig = rig_with(board(level), exposure_us=start_us, full_scale_dn=full_scale_dn)
    exposure_us = auto_exposure(rig)
    assert exposure_us == rig.exposure_us
    full_well_dn = NOISE.full_well_e / NOISE.electrons_per_dn
    expected = 0.8 * min(full_well_dn, FULL_SCALE_DN - BLACK_DN)
    # The percentile of 2.5 % bright pixels lies above their mean by 0.84 of their noise, 3 DN at most.
    assert level * exposure_us / 1e3 == pytest.approx(expected, rel=0.07)
    assert len(rig.captures) <= 8


def test_glints_do_not_count():
    light = board(1.0)
    light.flat[-int(0.003 * light.size) :] = 1000.0
    rig = rig_with(light)
    assert 1.0 * auto_exposure(rig) / 1e3 == pytest.approx(200, rel=0.07)
    assert BRIGHTEST_PERCENTILE < 99.7


def test_the_longest_exposure_is_kept_where_light_is_scarce():
    rig = rig_with(board(0.01))
    assert auto_exposure(rig) == rig.exposure_limits_us[1]


def test_too_much_and_too_little_light_are_refused():
    with pytest.raises(InputError, match="saturated at the shortest exposure"):
        auto_exposure(rig_with(board(100.0)))
    with pytest.raises(InputError, match="dark at the longest exposure"):
        auto_exposure(rig_with(board(1e-5)))


def test_brackets_are_multiples_of_the_present_exposure_which_is_set_again():
    rig = rig_with(board(5.0))
    merged = capture_bracketed(rig, PAPER.patterns(*rig.shape), (4.0, 1.0))
    assert rig.captures == [4e4, 1e4]
    assert rig.exposure_us == 1e4
    assert merged.frames.exposure_us == 4e4


def test_brackets_beyond_the_limits_are_refused_before_anything_is_captured():
    rig = rig_with(board(5.0))
    for ratios in ((4.0, 0.5), (1e6, 1.0)):
        with pytest.raises(InputError, match="outside the camera's limits"):
            capture_bracketed(rig, PAPER.patterns(*rig.shape), ratios)
    assert rig.captures == []


def test_merged_grey_values_are_unbiased_with_the_variance_that_is_stated():
    """From bright, where only the short exposure counts, to dark, where both do; in dark and bright frames of each.

    Pixels differ by a whole grey value of the short exposure, so that its rounding errors are evenly spread.
    """
    rng = np.random.default_rng(2)
    level = np.array([0.5, 1.0, 3.0, 8.0])  # DN per ms; 40 ms saturate at 6.3
    share = np.tile([0.2, 1.8], 25)  # of the level, in each frame
    light = share[:, None, None] * level[:, None] + np.linspace(-0.05, 0.05, 2000)
    merged = merge([exposed(light, 4e4, rng), exposed(light, 1e4, rng)], NOISE)
    assert not merged.saturated.any()
    error = merged.frames.stack - light * 40
    for frames in (share == 0.2, share == 1.8):
        stated = merged.variance.at(merged.frames.stack[frames].mean(axis=0)).mean(axis=-1)
        for row in range(4):
            # 50 000 values: the mean is known to sigma / 224, the variance to 0.63 %.
            sigma = float(error[frames, row].std())
            assert error[frames, row].mean() == pytest.approx(0, abs=5 * sigma / 224)
            assert sigma**2 == pytest.approx(stated[row], rel=0.035)
    longest_alone = camera_variance(NOISE, quantised=True).at(level * 40)
    assert merged.variance.at(merged.frames.stack.mean(axis=0))[0].mean() < longest_alone[0]


def test_where_every_exposure_is_saturated_the_merge_says_so_and_decoding_is_invalid():
    rng = np.random.default_rng(3)
    column = np.linspace(20, 580, 300)
    level = np.array([1.0, 8.0, 40.0])[:, None]
    light = np.stack(
        [
            level * (1 + 0.7 * np.cos(2 * pi * column / period + 2 * pi * n / steps))
            for period, steps in zip(PAPER.periods, PAPER.steps, strict=True)
            for n in range(steps)
        ]
    )
    merged = merge([exposed(light, 4e4, rng), exposed(light, 1e4, rng)], NOISE)
    assert merged.saturated.all(axis=1).tolist() == [False, False, True]
    assert np.isinf(merged.frames.stack[:, 2]).all()
    phase_map = decode(merged.frames, PAPER, merged.variance)
    assert phase_map.valid.all(axis=1).tolist() == [True, True, False]
    assert not phase_map.valid[2].any()
    error = phase_map.absolute[:2] - 2 * pi * column / 12
    normalised = error / phase_map.sigma[:2]
    assert normalised.std() == pytest.approx(1, abs=0.15)  # 600 pixels: 5 standard deviations


def test_the_order_of_exposures_does_not_matter():
    rng = np.random.default_rng(4)
    light = rng.uniform(0, 10, (24, 5, 20))
    long, short = exposed(light, 4e4, rng), exposed(light, 1e4, rng)
    one, other = merge([long, short], NOISE), merge([short, long], NOISE)
    np.testing.assert_allclose(one.frames.stack, other.frames.stack, rtol=1e-5, atol=1e-4)
    assert one.frames.exposure_us == other.frames.exposure_us == 4e4
