"""Claims about the predicted transfer of heights, against pictures of relief that are computed and blurred."""

import numpy as np
import pytest

from greenough.twin.validation.acceptance.relief_transfer import ReliefTransfer

FRINGES = 5 / 107  # cycles per px, whole periods in the picture
LEAN = np.radians(6.0)
SIGMA_PX = 1.5  # of a Gaussian blur, whose transfer function is known
PIXELS = 107 * 8


def blur(frequency: float) -> float:
    return float(np.exp(-2 * (np.pi * SIGMA_PX * frequency) ** 2))


def transfer(filter_sigma: float = 0.0) -> ReliefTransfer:
    shading = np.tan(LEAN) / (np.tan(LEAN) * np.cos(LEAN) + np.sin(LEAN))
    return ReliefTransfer(lambda at: blur(np.hypot(*at)), FRINGES, float(shading), filter_sigma)


def amplitude_left(frequency: float, amplitude_px: float = 0.02) -> float:
    """Of relief across the fringes: twelve pictures of a shaded surface, blurred, and decoded as the pipeline does."""
    s = np.arange(PIXELS) + 0.0
    z, slope = (
        amplitude_px * np.cos(2 * np.pi * frequency * s),
        -amplitude_px * 2 * np.pi * frequency * np.sin(2 * np.pi * frequency * s),
    )
    # The projector leans towards +x: light is what the normal (-slope, 1) has of its direction (sin, cos).
    light = (np.cos(LEAN) - slope * np.sin(LEAN)) / np.sqrt(1 + slope**2)
    phase = 2 * np.pi * FRINGES * (s - (np.tan(LEAN) * np.cos(LEAN) + np.sin(LEAN)) * z)
    steps = 2 * np.pi * np.arange(12) / 12
    pictures = light * (1 + 0.8 * np.cos(phase + steps[:, None]))
    otf = np.array([blur(f) for f in np.fft.fftfreq(PIXELS)])
    blurred = np.fft.ifft(np.fft.fft(pictures, axis=1) * otf, axis=1).real
    phasor = np.sum(blurred * np.exp(-1j * steps[:, None]), axis=0)
    seen = np.angle(phasor * np.exp(-2j * np.pi * FRINGES * s))
    height = -seen / (2 * np.pi * FRINGES * (np.tan(LEAN) * np.cos(LEAN) + np.sin(LEAN)))
    return float(2 * np.mean(height * np.cos(2 * np.pi * frequency * s)) / amplitude_px)


@pytest.mark.parametrize("cycles", [8, 40, 100, 160])
def test_across_the_fringes_it_is_what_decoded_pictures_show(cycles):
    """Relief so low that squares of its slope count for nothing."""
    frequency = cycles / PIXELS
    assert transfer().across(frequency) == pytest.approx(amplitude_left(frequency), abs=2e-3)


def test_shading_costs_height_across_the_fringes_and_none_along_them():
    frequency = 80 / PIXELS
    unshaded = ReliefTransfer(transfer().blur, FRINGES, 0.0, 0.0)
    assert transfer().across(frequency) < unshaded.across(frequency) - 0.02
    # A Gaussian of both frequencies is the product of two.
    assert transfer().along(frequency) == pytest.approx(blur(frequency))


def test_the_filter_multiplies_and_the_limit_is_where_half_is_left():
    frequency = 60 / PIXELS
    gaussian = np.exp(-2 * (np.pi * 3.0 * frequency) ** 2)
    assert transfer(3.0).across(frequency) == pytest.approx(gaussian * transfer().across(frequency))
    for axis, of in (("x", transfer(3.0).across), ("y", transfer(3.0).along)):
        assert of(1 / transfer(3.0).limit_px(axis)) == pytest.approx(0.5, abs=1e-6)
    both = np.hypot(SIGMA_PX, 3.0)
    assert transfer(3.0).limit_px("y") == pytest.approx(np.pi * both * np.sqrt(2 / np.log(2)), rel=1e-6)
