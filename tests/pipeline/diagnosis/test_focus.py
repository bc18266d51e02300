"""Claims about focus: where contrast says that it lies, and what it costs to have it elsewhere."""

import numpy as np
import pytest

from greenough.pipeline.diagnosis.finding import Yardstick
from greenough.pipeline.diagnosis.focus import check_focus_map, check_focus_range, contrast_map

SCALE = Yardstick(163.0, 0.5)
HEIGHTS = np.linspace(-1.4, 1.4, 12)


def through(focus_mm, seed=1, curvature=0.05):
    """Contrast at HEIGHTS: two paths of NA 0.015 take 0.05 z² of fringes of 0.21 mm."""
    noise = np.random.default_rng(seed).normal(0, 1e-3, len(HEIGHTS))
    return 0.75 * np.exp(-curvature * (HEIGHTS - focus_mm) ** 2 + noise)


@pytest.mark.parametrize("focus", [-1.0, 1.0])
def test_a_focus_that_is_a_millimetre_off_is_found_with_its_sign(focus):
    (finding,) = check_focus_range(HEIGHTS, through(focus), 0.01, "planes", SCALE)
    assert finding.name == "defocus"
    assert finding.evidence["focus_off_mm"] == pytest.approx(focus, abs=0.1)
    # From 1.4 mm to 2.4 mm off: exp(0.05 (2.4² - 1.4²)) against a symmetric range.
    assert finding.evidence["noise_added_share"] == pytest.approx(np.expm1(2 * 0.05 * 1.4), rel=0.1)
    assert finding.effect_rad == pytest.approx(0.01 * finding.evidence["noise_added_share"])


def test_a_focus_near_the_middle_is_no_finding():
    assert [check_focus_range(HEIGHTS, through(0.15, seed), 0.01, "planes", SCALE) for seed in range(20)] == [[]] * 20


def test_noise_alone_is_no_focus():
    noise = np.exp(np.random.default_rng(5).normal(0, 0.05, (200, len(HEIGHTS))))
    found = [bool(check_focus_range(HEIGHTS, 0.7 * each, 0.01, "planes", SCALE)) for each in noise]
    assert sum(found) <= 2  # one in a thousand is accepted


def test_few_heights_tell_nothing():
    assert check_focus_range(HEIGHTS[:5], through(-1.0)[:5], 0.01, "planes", SCALE) == []


def test_contrast_does_not_depend_on_brightness(taken):
    contrast = contrast_map(taken())
    np.testing.assert_allclose(contrast[np.isfinite(contrast)], 1.0, atol=0.03)


def test_blur_in_a_corner_is_found_there(taken, paint):
    stack = paint(noise=None).astype(float)
    corner = (np.arange(60) >= 40)[:, None] & (np.arange(160) >= 60)
    fine = stack[12:]
    fine[:, corner] = fine.mean(axis=0)[corner] + 0.3 * (fine - fine.mean(axis=0))[:, corner]
    (finding,) = check_focus_map(taken(np.rint(stack).astype(np.uint8)), SCALE)
    assert finding.where.startswith("test, worst bottom")
    assert check_focus_map(taken(), SCALE) == []
