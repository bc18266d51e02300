"""Claims about single frames: shifts and gains are found as they were made, and told from each other."""

import numpy as np
import pytest

from greenough.pipeline.diagnosis.finding import Yardstick
from greenough.pipeline.diagnosis.frame_shifts import check_frames, frame_errors
from greenough.pipeline.fringes import FringeSet

SCALE = Yardstick(163.0, 0.5)
PX = 163 * 2 * np.pi / 12  # µm of height that shift the finest fringes by a column


def shaken(seed, sd_um):
    return np.random.default_rng(seed).normal(0, sd_um / PX, 24)


def test_shifts_are_estimated_but_for_their_mean(taken):
    shifts = shaken(1, 3.0)
    sequence = taken(shifts_px=shifts)
    fit = sequence.fits[-1]
    found = frame_errors(fit, fit.residual, sequence.brightness_gradients, sequence.grey_variance).shifts_rad
    made = 2 * np.pi / 12 * shifts[-12:]
    np.testing.assert_allclose(found - found.mean(), made - made.mean(), atol=0.004)


def test_vibration_is_found_and_is_no_flicker(taken):
    for seed in range(5):
        findings = check_frames(taken(shifts_px=shaken(seed, 3.0), seed=seed), SCALE)
        assert [finding.name for finding in findings] == ["vibration"]
        made = PX * np.std(shaken(seed, 3.0)[-12:], ddof=1)
        assert findings[0].evidence["height_sd_um"] == pytest.approx(made, rel=0.15)


def test_flicker_is_found_and_is_no_vibration(taken):
    gains = np.random.default_rng(2).normal(1, 0.05, 24)
    findings = check_frames(taken(gains=gains), SCALE)
    assert [finding.name for finding in findings] == ["flicker"]
    assert findings[0].evidence["gain_sd"] == pytest.approx(np.std(gains[-12:], ddof=1), rel=0.15)


@pytest.mark.parametrize("gamma", [1.0, 1.8])
def test_still_frames_are_still_whatever_the_response(taken, gamma):
    assert [check_frames(taken(seed=seed, gamma=gamma), SCALE) for seed in range(5)] == [[]] * 5


def test_what_an_instrument_states_of_itself_is_no_finding(taken):
    assert (
        check_frames(taken(shifts_px=shaken(1, 0.1), gains=np.random.default_rng(1).normal(1, 0.001, 24)), SCALE) == []
    )


def test_four_frames_are_not_asked(taken):
    assert check_frames(taken(fringes=FringeSet((608, 152, 40, 12), (4, 4, 4, 4))), SCALE) == []
