"""Claims about transfer functions and the response of a pixel."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.special import j0

from greenough.twin.diffraction import (
    airy_radius,
    cutoff_frequency,
    defocused_transfer,
    geometric_transfer,
    optical_transfer,
    pixel_response,
)

NA, WAVELENGTH = 0.015, 0.525e-3
FRINGE = 1 / 0.214  # frequency of the paper's densest fringe on the specimen, 1/mm

apertures = st.floats(0.002, 0.1)
wavelengths = st.floats(0.3e-3, 1e-3)
heights = st.floats(-3, 3)


def transfer_from_pupil(defocus: float) -> tuple[np.ndarray, np.ndarray]:
    """Frequencies and transfer function as the autocorrelation of a sampled pupil, by two-dimensional transforms."""
    n, radius = 1024, 250  # samples across the frame, and in the pupil's radius
    x = np.fft.fftfreq(n, 1 / n) / radius
    square = x[:, None] ** 2 + x[None, :] ** 2
    path = NA**2 / 2 * defocus * square  # of the paraxial sphere against the plane in focus
    pupil = (square <= 1) * np.exp(2j * np.pi / WAVELENGTH * path)
    transfer = np.fft.ifft2(np.abs(np.fft.fft2(pupil)) ** 2)[0, : 2 * radius + 1]
    shift = np.arange(2 * radius + 1) / radius  # in pupil radii: 2 is the cut-off
    return shift / 2 * cutoff_frequency(NA, WAVELENGTH), (transfer / transfer[0]).real


@pytest.mark.parametrize("defocus", [-1.5, 0.7, 1.5])
def test_defocused_transfer_is_the_autocorrelation_of_the_pupil(defocus):
    frequency, transfer = transfer_from_pupil(defocus)
    # The staircase rim of a disc of radius 250 misses its area by less than a thousandth.
    np.testing.assert_allclose(defocused_transfer(frequency, NA, WAVELENGTH, defocus), transfer, atol=1e-3)


def test_transfer_in_focus_is_the_autocorrelation_of_the_pupil():
    frequency, transfer = transfer_from_pupil(0.0)
    np.testing.assert_allclose(optical_transfer(frequency, NA, WAVELENGTH), transfer, atol=1e-3)


@settings(max_examples=30)
@given(apertures, wavelengths, st.floats(0, 1.2))
def test_without_defocus_both_transfer_functions_agree(na, wavelength, share):
    frequency = np.array([share * cutoff_frequency(na, wavelength)])
    np.testing.assert_allclose(
        defocused_transfer(frequency, na, wavelength, 0.0), optical_transfer(frequency, na, wavelength), atol=1e-6
    )


@settings(max_examples=30)
@given(apertures, wavelengths, heights)
def test_transfer_is_whole_at_zero_and_nothing_beyond_the_cutoff(na, wavelength, defocus):
    ends = np.array([0.0, 1.0, 1.5]) * cutoff_frequency(na, wavelength)
    np.testing.assert_allclose(optical_transfer(ends, na, wavelength), [1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(defocused_transfer(ends, na, wavelength, defocus), [1, 0, 0], atol=1e-6)


@settings(max_examples=30)
@given(apertures, wavelengths, heights, st.floats(0, 1))
def test_defocus_never_adds_contrast(na, wavelength, defocus, share):
    frequency = np.array([share * cutoff_frequency(na, wavelength)])
    focused = optical_transfer(frequency, na, wavelength)
    assert np.abs(defocused_transfer(frequency, na, wavelength, defocus)) <= focused + 1e-6


@pytest.mark.parametrize("frequency", [0.0, 1.0, FRINGE, 30.0])
def test_geometric_transfer_is_the_mean_over_a_uniform_disc(frequency):
    radius = NA * 1.5
    chord = 2 / np.pi / radius**2
    mean, _ = quad(
        lambda x: chord * np.sqrt(radius**2 - x**2) * np.cos(2 * np.pi * frequency * x), -radius, radius, limit=200
    )
    assert geometric_transfer(np.array(frequency), NA, -1.5) == pytest.approx(mean, abs=1e-6)


@pytest.mark.parametrize("defocus", [-1.5, -0.5, 0.5, 1.5])
def test_product_of_the_two_blurs_loses_less_than_a_hundredth_of_a_fringe(defocus):
    """The bound: cos(a x) with a = 2 pi NA defocus frequency is averaged over the overlap of the pupils, not over all.

    The overlap's points can be matched one by one with the disc's, in the order of |x| and each with a smaller |x|, and
    |cos u - cos v| <= |u^2 - v^2| / 2; hence the averages differ by at most a^2 / 2 times the difference of the mean
    squares of x, and the transfer functions by that times the overlap's area, which is the focused transfer function.
    """
    focused = optical_transfer(np.array(FRINGE), NA, WAVELENGTH)
    product = focused * geometric_transfer(np.array(FRINGE), NA, defocus)
    wave = defocused_transfer(np.array([FRINGE]), NA, WAVELENGTH, defocus)[0]

    q = FRINGE / cutoff_frequency(NA, WAVELENGTH)
    area, _ = quad(lambda x: np.sqrt(1 - (x + q) ** 2), 0, 1 - q)
    moment, _ = quad(lambda x: x**2 * np.sqrt(1 - (x + q) ** 2), 0, 1 - q)
    a = 2 * np.pi * NA * defocus * FRINGE
    bound = focused * a**2 / 2 * (1 / 4 - moment / area)
    assert 0 < wave - product <= bound < 0.01


def test_the_figures_that_the_module_states_for_the_product_hold():
    frequency = np.linspace(0, cutoff_frequency(NA, WAVELENGTH), 1000)
    wave = defocused_transfer(frequency, NA, WAVELENGTH, 1.5)
    product = optical_transfer(frequency, NA, WAVELENGTH) * geometric_transfer(frequency, NA, 1.5)
    assert np.interp(FRINGE, frequency, wave) == pytest.approx(0.856, abs=5e-4)
    assert np.interp(FRINGE, frequency, product) == pytest.approx(0.848, abs=5e-4)
    worst = np.argmax(np.abs(wave - product))
    assert abs(wave - product)[worst] == pytest.approx(0.25, abs=5e-3)
    assert frequency[worst] == pytest.approx(27, abs=0.5)
    assert (product <= wave + 1e-9).all()


@pytest.mark.parametrize(("defocus", "noise_percent"), [(0.5, 0.2), (1.5, 1.9)])
def test_the_product_overstates_noise_by_less_than_two_percent(defocus, noise_percent):
    """Noise of the phase is in proportion to the inverse of the contrast, which both paths lower alike."""
    wave = np.interp(FRINGE, *transfer_from_pupil(defocus))
    product = optical_transfer(np.array(FRINGE), NA, WAVELENGTH) * geometric_transfer(np.array(FRINGE), NA, defocus)
    assert 100 * ((wave / product) ** 2 - 1) == pytest.approx(noise_percent, abs=0.06)


@pytest.mark.parametrize(
    ("defocus", "bound_um", "at_least_um"), [(0.25, 0.5, 0.3), (0.5, 1.5, 1.2), (1.0, 4.0, 3.5), (1.5, 6.5, 6.0)]
)
def test_the_product_drags_phases_on_waves_of_brightness_by_so_much_more_or_less(defocus, bound_um, at_least_um):
    """A fringe of frequency f under 1 + cos(g x) / 2, through T: T(f) + T(f + g) e^(igx) / 4 + T(f - g) e^(-igx) / 4.

    The worst over all waves up to the pixels' limit, in height at 0.163 mm/rad, as ``docs/physics.md`` states it.
    """
    frequency, wave = transfer_from_pupil(defocus)
    product = optical_transfer(frequency, NA, WAVELENGTH) * geometric_transfer(frequency, NA, defocus)
    g = np.arange(0.1, 50, 0.1)[:, None]
    turn = np.exp(2j * np.pi * np.arange(180) / 180)

    def dragged(transfer: np.ndarray) -> np.ndarray:
        def t(f: np.ndarray) -> np.ndarray:
            return np.interp(np.abs(f), frequency, transfer, right=0) * np.sinc(f * 224.56 / 22683)

        return t(FRINGE + 0 * g) + t(FRINGE + g) * turn / 4 + t(FRINGE - g) * turn.conj() / 4

    apart = 163.1 * np.abs(np.angle(dragged(wave) * dragged(product).conj()))
    assert at_least_um < apart.max() < bound_um


def test_the_wave_optical_spot_keeps_a_peak_that_the_product_loses():
    """A defocused pupil leaves (sin w / w)^2 of it, w = pi NA^2 z / (2 wavelength) (Born and Wolf, 8.8)."""
    frequency, wave = transfer_from_pupil(1.5)
    focused = optical_transfer(frequency, NA, WAVELENGTH)
    product = focused * geometric_transfer(frequency, NA, 1.5)
    of_wave, of_product = ((t * frequency).sum() / (focused * frequency).sum() for t in (wave, product))
    w = np.pi * NA**2 * 1.5 / (2 * WAVELENGTH)
    assert of_wave == pytest.approx((np.sin(w) / w) ** 2, abs=2e-3)
    assert of_product == pytest.approx(0.21, abs=5e-3)


def test_the_airy_disc_of_the_default_path_has_a_radius_of_21_um_and_holds_its_share_of_the_light():
    radius = airy_radius(NA, WAVELENGTH)
    assert radius == pytest.approx(0.61 * WAVELENGTH / NA, rel=1e-3)
    assert radius == pytest.approx(0.0213, abs=1e-4)
    # The light within r is a transform of the transfer function; the Airy disc's share is 1 - J0^2 (Rayleigh).
    x = 2 * np.pi * NA / WAVELENGTH * radius
    assert 1 - j0(x) ** 2 == pytest.approx(0.838, abs=1e-3)


@pytest.mark.parametrize("pixel", [224.56 / 22683, 4 * 224.56 / 22683])
@pytest.mark.parametrize("direction", [(1.0, 0.0), (0.0, 1.0), (0.6, 0.8)])
def test_what_is_drawn_from_a_pixels_response_has_the_transfer_of_box_and_pupil(pixel, direction):
    marginal, conditional = pixel_response(pixel, NA, WAVELENGTH)
    u, v = (np.arange(4096) + 0.5) / 4096, (np.arange(1024) + 0.5) / 1024
    x = np.interp(u, np.linspace(0, 1, len(marginal)), marginal)[:, None]
    rows = np.stack([np.interp(v, np.linspace(0, 1, conditional.shape[1]), row) for row in conditional])
    at = u * (len(rows) - 1)
    below = np.minimum(at.astype(int), len(rows) - 2)
    t = (at - below)[:, None]
    y = rows[below] * (1 - t) + rows[below + 1] * t
    for cycles in np.linspace(0.1, 0.7, 5):  # per pixel
        fx, fy = cycles * direction[0], cycles * direction[1]
        expected = optical_transfer(np.array(cycles / pixel), NA, WAVELENGTH) * np.sinc(fx) * np.sinc(fy)
        assert np.cos(2 * np.pi * (fx * x + fy * y)).mean() == pytest.approx(expected, abs=0.004)


def test_a_pixels_response_is_symmetric_to_the_last_bit():
    marginal, conditional = pixel_response(224.56 / 22683, NA, WAVELENGTH)
    np.testing.assert_array_equal(marginal, -marginal[::-1])
    np.testing.assert_array_equal(conditional, -conditional[:, ::-1])
    np.testing.assert_array_equal(conditional, conditional[::-1])
    assert (np.diff(marginal) >= 0).all()
    assert (np.diff(conditional, axis=1) >= 0).all()
