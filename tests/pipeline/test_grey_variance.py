import numpy as np
import pytest

from greenough.instrument.contract import CameraNoise
from greenough.pipeline.fringes import PAPER, FringeSet
from greenough.pipeline.grey_variance import camera_variance, estimate_variance

NOISE = CameraNoise(full_well_e=6500.0, read_noise_e=10.0, electrons_per_dn=25.9)
BLACK_DN = 4.0


def photographed(background, contrast, rng, shape=(300, 400)):
    """8-bit frames by eq. 1 with the noise of ``NOISE``, (frames, *shape)."""
    column = np.linspace(20, 580, shape[1])
    light = np.stack(
        [
            background * np.broadcast_to(1 + contrast * np.cos(2 * np.pi * (column / period + n / steps)), shape)
            for period, steps in zip(PAPER.periods, PAPER.steps, strict=True)
            for n in range(steps)
        ]
    )
    electrons = rng.poisson(light * NOISE.electrons_per_dn) + rng.normal(0, NOISE.read_noise_e, light.shape)
    return np.clip(np.rint(electrons / NOISE.electrons_per_dn + BLACK_DN), 0, 255).astype(np.uint8)


def test_a_data_sheet_gives_the_variance_of_single_grey_values():
    """Over a whole grey value, so that rounding errors are evenly spread."""
    rng = np.random.default_rng(1)
    variance = camera_variance(NOISE, quantised=True)
    for level in (1.0, 10.0, 100.0):
        light = np.linspace(level - 0.5, level + 0.5, 300)[:, None]
        error = photographed(light, 0.0, rng) - BLACK_DN - light
        # 2 880 000 values: 5 standard deviations of their variance are 0.4 %.
        assert error.var() == pytest.approx(variance.at(np.array(level)), rel=0.005)
    assert camera_variance(NOISE, quantised=False).at(np.array(-3.0)) == pytest.approx((10 / 25.9) ** 2)


@pytest.mark.parametrize("background", [np.linspace(3, 120, 300)[:, None], np.full((300, 1), 110.0)], ids=str)
def test_noise_estimated_from_the_frames_is_the_photon_transfer_line(background):
    """Also where all pixels are alike: then bright and dark frames tell what depends on the light."""
    frames = photographed(background, 0.9, np.random.default_rng(4))
    estimate = estimate_variance(frames, PAPER, BLACK_DN, 255.0)
    light = np.array([0.0, 20.0, 110.0])
    expected = camera_variance(NOISE, quantised=True)
    np.testing.assert_allclose(estimate.at(light), expected.at(light), rtol=0.05, atol=0.15)


def test_noise_that_does_not_depend_on_the_light_is_seen_as_such():
    rng = np.random.default_rng(5)
    angle = 2 * np.pi * (np.arange(12)[:, None, None] / 12 + rng.random((200, 300)))
    frames = 118 + 84 * np.cos(angle) + rng.normal(0, 2.0, angle.shape)
    estimate = estimate_variance(frames.astype(np.float32), FringeSet((608,), (12,)))
    np.testing.assert_allclose(estimate.at(np.array([0.0, 118.0, 200.0])), 4.0, rtol=0.08)


def test_three_steps_leave_nothing_to_estimate_from():
    fringes = FringeSet((300, 60), (3, 3))
    estimate = estimate_variance(np.full((6, 20, 20), 100, np.uint8), fringes)
    assert estimate.at(np.array(50.0)) == pytest.approx(1.0 + 1 / 12)


@pytest.mark.parametrize("vertical", [True, False])
def test_harmonics_are_not_taken_for_noise(vertical):
    """Four steps take the second harmonic for noise; along the fringes it is the same in neighbours."""
    rng = np.random.default_rng(4)
    column = np.broadcast_to(np.linspace(0, 600, 160), (160, 160))
    bent = [255 * (0.5 + 0.35 * np.cos(2 * np.pi * column / 40 + np.pi * n / 2)) ** 1.8 for n in range(4)]
    frames = np.array(bent if vertical else [image.T for image in bent]) + rng.normal(0, 2, (4, 160, 160))
    estimate = estimate_variance(frames.astype(np.float32), FringeSet((600,), (4,)))
    # 5000 values of one degree of freedom: the variance is known to 2 %, and two coefficients share it.
    assert np.mean(estimate.at(frames)) == pytest.approx(4.0, rel=0.15)
