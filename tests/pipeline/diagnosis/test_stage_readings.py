"""Claims about the stage: a slip is named with its plane and size, and ordinary errors are not."""

import numpy as np
import pytest

from greenough.pipeline.diagnosis.finding import Yardstick
from greenough.pipeline.diagnosis.stage_readings import check_stage

SCALE = Yardstick(163.0, 0.5)
READINGS = np.linspace(-1.45, 1.45, 30)


def heights(seed, sd_um=3.3):
    """Of a stage with independent errors, by a calibration whose scale is off by 1 ‰ and whose zero by 0.1 mm."""
    return 0.1 + 1.001 * READINGS + 1e-3 * np.random.default_rng(seed).normal(0, sd_um, len(READINGS))


@pytest.mark.parametrize("plane", [1, 7, 15, 28])
def test_a_slip_of_50_um_is_named_with_its_plane(plane):
    for seed in range(10):
        slipped = heights(seed) + 0.05 * (np.arange(30) >= plane)
        (finding,) = check_stage(READINGS, slipped, SCALE)
        assert finding.name == "stage slip"
        assert f"from plane {plane:02d} on" in finding.where
        assert finding.evidence["jump_um"] == pytest.approx(50, abs=15)


def test_a_single_plane_that_stood_elsewhere_is_named():
    (finding,) = check_stage(READINGS, heights(1) + 0.05 * (np.arange(30) == 12), SCALE)
    assert "at plane 12" in finding.where


@pytest.mark.slow
def test_ordinary_errors_of_a_stage_are_no_slip():
    assert sum(bool(check_stage(READINGS, heights(seed), SCALE)) for seed in range(1000)) <= 5  # 1 is expected


def test_a_slip_below_what_the_instrument_states_is_none():
    exact = heights(1, sd_um=1e-3)
    assert check_stage(READINGS, exact + 1e-4 * (np.arange(30) >= 9), SCALE) == []


def test_few_planes_tell_nothing():
    assert check_stage(READINGS[:6], heights(1)[:6] + 0.05 * (np.arange(6) >= 3), SCALE) == []
