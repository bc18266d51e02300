import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from greenough.instrument.errors import InputError
from greenough.pipeline.bundle_data import (
    MIN_SPOT_PHASES,
    SpotPhases,
    block_averages,
    block_map,
    check_spot_phases,
    measure_spot_phases,
)
from greenough.pipeline.decode import PhaseMap
from greenough.pipeline.spots import Spots

SHAPE = (240, 320)
CENTRES = np.array([[60.3, 50.8], [160.0, 120.4], [250.6, 200.2], [5.0, 100.0], [100.0, 200.0]])
RADII = np.array([20.0, 9.0, 8.7, 9.0, 9.0])


def spots(seen=(True,) * 5) -> Spots:
    axes, sigma = np.repeat(RADII[:, None], 2, axis=1), np.where(seen, 0.005, np.nan)
    return Spots(np.where(np.isfinite(sigma)[:, None], CENTRES, np.nan), axes, sigma)


def phase_map(phase, valid=None) -> PhaseMap:
    flat = np.ones(SHAPE, dtype=np.float32)
    return PhaseMap(phase.astype(np.float32), flat, flat, np.isfinite(phase) if valid is None else valid, flat, flat)


def slope(noise=0.0, seed=1):
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]]
    return 40.0 + 0.3 * u - 0.02 * v + np.random.default_rng(seed).normal(0, 1, SHAPE) * noise


def expected(centres):
    return 40.0 + 0.3 * centres[:, 0] - 0.02 * centres[:, 1]


def test_the_phase_of_a_plane_is_that_at_the_centre_with_its_gradient():
    found = measure_spot_phases(phase_map(slope()), spots())
    inside = [0, 1, 2, 4]
    np.testing.assert_allclose(found.phase_rad[inside], expected(CENTRES)[inside], atol=1e-4)
    np.testing.assert_allclose(found.gradient_rad[inside], [[0.3, -0.02]] * 4, atol=1e-5)


def test_noise_in_the_phase_has_the_stated_size():
    """60 maps of 3 spots: the mean square of 180 normalised errors is 1 to 5 * sqrt(2 / 180)."""
    errors = []
    for seed in range(60):
        found = measure_spot_phases(phase_map(slope(noise=0.01, seed=seed)), spots())
        errors += list(((found.phase_rad - expected(CENTRES)) / found.sigma_rad)[[0, 1, 2]])
    assert np.mean(np.square(errors)) == pytest.approx(1.0, abs=5 * np.sqrt(2 / 180))


def test_dark_ink_around_a_spot_does_not_move_its_phase():
    """Both are blurred together: the rim's phase is drawn inwards on either side, the centre's is not."""
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]]
    light = np.full(SHAPE, 0.08)
    for (x, y), radius in zip(CENTRES, RADII, strict=True):
        light[np.hypot(u - x, v - y) < radius] = 0.85
    phasor = light * np.exp(1j * slope())
    blurred = gaussian_filter(phasor.real, 1.0) + 1j * gaussian_filter(phasor.imag, 1.0)
    phase = slope() + np.angle(blurred * np.exp(-1j * slope()))
    rim = np.abs(np.hypot(u - CENTRES[1, 0], v - CENTRES[1, 1]) - RADII[1]) < 0.7
    assert np.abs((phase - slope())[rim]).max() > 0.03
    found = measure_spot_phases(phase_map(phase), spots())
    inside = [0, 1, 2, 4]
    assert np.abs(found.phase_rad - expected(CENTRES))[inside].max() < 0.002


def test_unseen_dark_and_cut_spots_have_no_phase():
    valid = np.ones(SHAPE, dtype=bool)
    valid[110:130, 140:158] = False
    found = measure_spot_phases(phase_map(slope(), valid), spots(seen=(True, True, True, True, False)))
    assert np.isfinite(found.phase_rad).tolist() == [True, False, True, True, False]
    assert np.array_equal(np.isfinite(found.sigma_rad), np.isfinite(found.phase_rad))


def test_too_few_phases_are_refused_with_their_number():
    few = SpotPhases(np.ones(99), np.ones((99, 2)), np.where(np.arange(99) < 9, 0.001, np.nan))
    with pytest.raises(InputError, match=f"from 45 spots with a phase in 5 postures: at least {MIN_SPOT_PHASES}"):
        check_spot_phases([few] * 5)
    check_spot_phases([few] * 6)


def test_blocks_average_phase_and_place_alike():
    phase = slope()
    phase[:, 200:] = np.nan
    phase[17, 33] = np.nan
    blocks = block_averages(phase)
    np.testing.assert_allclose(blocks.phase_rad, expected(blocks.pixels), atol=1e-9)
    assert len(blocks.phase_rad) == 30 * 25
    assert block_map(phase).shape == (30, 40)


def test_blocks_that_are_mostly_empty_are_left_out():
    phase = slope()
    phase[:6, :] = np.nan  # three quarters of the first row of blocks of 8 px
    assert len(block_averages(phase).phase_rad) == 29 * 40
    assert np.isnan(block_map(phase)[0]).all()


def test_a_picture_that_blocks_do_not_fill_is_cut_at_its_end():
    assert block_map(np.zeros((100, 85))).shape == (50, 42)
