import numpy as np
import pytest

from greenough.instrument.errors import InputError
from greenough.pipeline.decode import PhaseMap
from greenough.pipeline.phasor_filter import filter_phasors

SHAPE = (120, 160)
CARRIER = 0.3  # rad per px, as the paper's fringes have on the camera


def phase_map(absolute, modulation=80.0, sigma=0.01):
    flat = np.zeros(SHAPE, dtype=np.float32)
    valid = np.isfinite(absolute)
    return PhaseMap(absolute, flat + np.float32(modulation), flat + 100, valid, flat, flat + np.float32(sigma))


def tilted_plane():
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]]
    return 50.0 + CARRIER * u + 0.004 * v


def test_a_plane_stays_as_it_is_up_to_its_holes_and_edges():
    phase = tilted_plane()
    phase[40:60, 50:90] = np.nan
    filtered = filter_phasors(phase_map(phase), 4.0)
    np.testing.assert_array_equal(np.isnan(filtered.absolute), np.isnan(phase))
    assert np.nanmax(np.abs(filtered.absolute - phase)) < 1e-9


def test_a_weak_cosine_is_damped_as_a_gaussian_damps_it():
    _v, u = np.mgrid[: SHAPE[0], : SHAPE[1]]
    period, amplitude, fwhm = 16.0, 1e-3, 5.0
    wave = amplitude * np.cos(2 * np.pi * u / period)
    filtered = filter_phasors(phase_map(tilted_plane() + wave), fwhm).absolute - tilted_plane()
    sigma = fwhm / 2.354820045
    inner = slice(20, -20)
    gain = np.exp(-2 * (np.pi * sigma / period) ** 2)
    np.testing.assert_allclose(filtered[inner, inner], gain * wave[inner, inner], atol=2e-3 * amplitude)


def test_noise_shrinks_to_the_stated_sigma():
    rng = np.random.default_rng(6)
    sigma = 0.01
    filtered = filter_phasors(phase_map(tilted_plane() + rng.normal(0, sigma, SHAPE), sigma=sigma), 3.0)
    stated = filtered.sigma[20:-20, 20:-20]
    measured = (filtered.absolute - tilted_plane())[20:-20, 20:-20].std()
    # White noise through a Gaussian of sigma s keeps 1 / (2 s sqrt(pi)) of its standard deviation.
    assert stated.mean() == pytest.approx(sigma / (2 * 3.0 / 2.354820045 * np.sqrt(np.pi)), rel=0.01)
    # 9600 pixels in patches of about 4 pi s² = 20: 480 independent values, sd of their sd 3.2 %, five of them.
    assert measured == pytest.approx(stated.mean(), rel=0.16)


def test_bright_neighbours_count_more():
    # A step of the phase seen with modulations 3:1 is drawn to the brighter side by the phasors' weights.
    _, u = np.mgrid[: SHAPE[0], : SHAPE[1]]
    step = np.where(u < 80, 0.0, 0.1)
    even = filter_phasors(phase_map(tilted_plane() + step), 4.0).absolute - tilted_plane()
    bright = phase_map(tilted_plane() + step)
    bright.modulation[:, :80] *= 3
    uneven = filter_phasors(bright, 4.0).absolute - tilted_plane()
    assert (uneven[60, 79:81] < even[60, 79:81] - 0.01).all()


def test_the_fringe_order_of_a_pixel_is_its_own():
    phase = tilted_plane()
    phase[:, 80:] += 40 * np.pi
    filtered = filter_phasors(phase_map(phase), 3.0).absolute
    assert np.abs(filtered - phase).max() < np.pi


@pytest.mark.parametrize("width", [0.0, -1.0, 13.0, np.nan])
def test_a_width_out_of_range_is_refused(width):
    with pytest.raises(InputError, match="above 0 and at most 12 px"):
        filter_phasors(phase_map(tilted_plane()), width)
