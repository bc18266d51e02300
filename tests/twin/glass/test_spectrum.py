"""Claims about the spectrum."""

import numpy as np
import pytest

from greenough.twin.glass.spectrum import Spectrum
from greenough.twin.renderer import mi


def wavelengths(spectrum: Spectrum, n: int = 100_001) -> np.ndarray:
    return np.array(spectrum.wavelength_um(mi.Float((np.arange(n) + 0.5) / n)), float)


def test_uniform_samples_become_a_gaussian_of_the_stated_width():
    spectrum = Spectrum(0.525, 0.030)
    drawn = wavelengths(spectrum)
    assert drawn.mean() == pytest.approx(0.525, abs=1e-6)
    # Density at half the width against the middle, from the share of samples within 0.2 nm.
    near = [np.mean(np.abs(drawn - at) < 2e-4) for at in (0.525, 0.510, 0.540)]
    assert near[1] / near[0] == pytest.approx(0.5, abs=0.01)
    assert near[2] / near[0] == pytest.approx(0.5, abs=0.01)


def test_samples_at_the_ends_stay_in_the_spectrum():
    ends = np.array(Spectrum().wavelength_um(mi.Float([0.0, np.nextafter(1, 0, dtype=np.float32)])))
    assert ends == pytest.approx([0.465, 0.585], abs=3e-4)


def test_wavelength_grows_with_the_sample():
    assert (np.diff(wavelengths(Spectrum(), 1001)) > 0).all()


def test_without_width_all_light_has_one_wavelength():
    assert np.unique(wavelengths(Spectrum(0.525, 0.0))) == pytest.approx([0.525])


@pytest.mark.parametrize("shares", [2, 8, 64])
def test_middles_of_few_shares_have_the_variance_of_the_light(shares):
    spectrum = Spectrum(0.525, 0.030)
    middles = mi.Float((np.arange(shares) + 0.5) / shares)
    few = np.array(spectrum.wavelength_um(middles, spectrum.parting(shares)), float)
    assert few.mean() == pytest.approx(0.525, abs=1e-6)
    assert few.std() == pytest.approx(wavelengths(spectrum).std(), rel=1e-3)
