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


@pytest.mark.parametrize("fwhm", [2.0, 4.4, 7.0])
@pytest.mark.parametrize("along", [True, False])
def test_half_of_a_wave_passes_at_the_period_that_the_gaussian_says(fwhm, along):
    """The lateral resolution, measured: waves of several periods in the phase, and where the response crosses 50 %.

    Theory: exp(-2 (pi s / p)²) is a half at p = pi s sqrt(2 / ln 2). The course, a carrier, may be taken out a little
    wrongly, by the wave's own slope over the picture.
    """
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]]
    place = u if along else v
    sigma = fwhm / (2 * np.sqrt(2 * np.log(2)))
    expected = np.pi * sigma * np.sqrt(2 / np.log(2))
    periods, responses = expected * np.array([0.8, 0.9, 1.0, 1.1, 1.25]), []
    inner = (slice(30, -30), slice(30, -30))
    for period in periods:
        waves = np.stack([np.cos(2 * np.pi * place / period), np.sin(2 * np.pi * place / period)])
        filtered = filter_phasors(phase_map(tilted_plane() + 1e-3 * waves[0]), fwhm).absolute - tilted_plane()
        design = np.stack([*(wave[inner].ravel() for wave in waves), np.ones(waves[0][inner].size)], axis=-1)
        cosine, sine, _ = np.linalg.lstsq(design, filtered[inner].ravel(), rcond=None)[0]
        responses.append(np.hypot(cosine, sine) / 1e-3)
    np.testing.assert_allclose(responses, np.exp(-2 * (np.pi * sigma / periods) ** 2), atol=0.005)
    measured = np.interp(0.5, responses, periods)
    assert measured == pytest.approx(expected, rel=0.01)
    assert measured == pytest.approx(2.266 * fwhm, rel=0.01)


@pytest.mark.parametrize(("height", "low", "high"), [(1.0, 0.83, 1.11), (2.5, 0.75, 1.03)])
def test_noise_of_the_weights_counts_where_neighbours_lie_beside_the_plane(height, low, high):
    """A step of the phase, measured 100 times, the modulation each time as noisy as the phase.

    The 20 rows at the edge hold about 4 independent values for each column, and 100 repeats 400: their variance is
    known to 7 %, that of ten columns together, which are neighbours, to about 3.5 %. At large steps pixels lie less far
    beside each other's planes than beside their own, for which they are taken: too much is stated.
    """
    rng = np.random.default_rng(5)
    step = 0.3 * np.arange(40) + np.where(np.arange(40) < 20, 0.0, height) + np.zeros((40, 1))
    sigma, repeats = 0.03, []
    for _ in range(100):
        phase = step + rng.normal(0, sigma, step.shape)
        seen = (sigma / (1 + rng.normal(0, sigma, step.shape))).astype(np.float32)
        flat = np.zeros(step.shape, np.float32)
        one = PhaseMap(phase, flat + 80, flat + 100, np.ones(step.shape, bool), flat, seen)
        repeats.append(filter_phasors(one, 3.0))
    edge = (slice(10, 30), slice(15, 25))
    scatter = np.var([found.absolute[edge] for found in repeats], axis=0, ddof=1).mean()
    stated = np.mean([found.sigma[edge] ** 2 for found in repeats])
    assert low < scatter / stated < high


def test_brightness_does_not_drag_the_phase():
    """Slopes of a roof, which no linear course of the whole picture takes out, where brightness rises and jumps.

    The mean of phasors weighted by their modulation is off by slope times relative change times variance of the
    Gaussian, on the ramp by 0.02 / 70 x 1.8² = 1 mrad, and far more at the jump.
    """
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]]
    roof = tilted_plane() + 0.02 * np.abs(u - 80.0)
    for modulation in (20.0 + u, np.where(v + u < 100, 10.0, 300.0)):
        modulation = modulation.astype(np.float32)
        left = filter_phasors(phase_map(roof, modulation, sigma=0.8 / modulation), 4.3).absolute - roof
        assert np.abs(left[:, np.abs(np.arange(SHAPE[1]) - 80) > 10]).max() < 1e-4  # of third order in the slope


def test_precise_neighbours_count_more():
    """Two pixels' noise of which one is ten times the other's: the mean takes the better one's, not their average's."""
    rng = np.random.default_rng(8)
    sigma = np.where(np.indices(SHAPE).sum(axis=0) % 2 == 0, 0.001, 0.01)
    noisy = phase_map(tilted_plane() + sigma * rng.standard_normal(SHAPE), sigma=sigma.astype(np.float32))
    filtered = filter_phasors(noisy, 4.3)
    inner = slice(20, -20)
    scatter = (filtered.absolute - tilted_plane())[inner, inner].std()
    # Half of the pixels share 1 / (2 s sqrt(pi)): sqrt(2) of it. 9 600 pixels in patches of 42: sd known to 4.7 %.
    assert scatter == pytest.approx(0.001 * np.sqrt(2) / (2 * 1.826 * np.sqrt(np.pi)), rel=0.24)
    assert filtered.sigma[inner, inner].mean() == pytest.approx(scatter, rel=0.24)


def test_frames_without_noise_are_filtered_evenly():
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]]
    wave = 1e-3 * np.cos(u / 3) * np.cos(v / 4)
    perfect, even = (filter_phasors(phase_map(tilted_plane() + wave, sigma=s), 4.3).absolute for s in (0.0, 0.01))
    np.testing.assert_allclose(perfect, even, atol=1e-9)


def test_nothing_valid_comes_back_as_it_is():
    nothing = phase_map(np.full(SHAPE, np.nan))
    assert filter_phasors(nothing, 4.3) is nothing


def test_the_fringe_order_of_a_pixel_is_its_own():
    phase = tilted_plane()
    phase[:, 80:] += 40 * np.pi
    filtered = filter_phasors(phase_map(phase), 3.0).absolute
    assert np.abs(filtered - phase).max() < np.pi


@pytest.mark.parametrize("width", [0.0, -1.0, 13.0, np.nan])
def test_a_width_out_of_range_is_refused(width):
    with pytest.raises(InputError, match="above 0 and at most 12 px"):
        filter_phasors(phase_map(tilted_plane()), width)
