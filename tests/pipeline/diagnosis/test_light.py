"""Claims about light: patches at full scale, too short exposures, light without fringes."""

import numpy as np
import pytest

from greenough.pipeline.diagnosis.finding import Yardstick
from greenough.pipeline.diagnosis.light import check_light, check_saturation

SCALE = Yardstick(163.0, 0.5)


def names(findings):
    return [finding.name for finding in findings]


def glint(radius_px):
    v, u = np.mgrid[:60, :160]
    return 1 + 4 * (np.hypot(v - 30, u - 80) < radius_px)


def test_a_glint_is_saturated_and_its_share_is_said(taken):
    (finding,) = check_saturation(taken(light=glint(8)), SCALE)
    assert finding.name == "saturation"
    assert finding.evidence["largest_patch_px"] == pytest.approx(np.pi * 64, rel=0.15)
    assert finding.evidence["saturated_share"] == pytest.approx(np.pi * 64 / 9600, rel=0.15)
    assert finding.effect_rad == pytest.approx(2 * np.pi * np.sqrt(finding.evidence["saturated_share"]))


def test_single_hot_pixels_and_bright_light_below_full_scale_are_not(taken, paint):
    stack = paint()
    stack[:, ::10, ::10] = 255
    assert check_saturation(taken(stack), SCALE) == []
    assert check_saturation(taken(full_dn=225.0), SCALE) == []


def test_sound_light_is_no_finding(taken):
    assert [check_light(taken(seed=seed), SCALE) for seed in range(5)] == [[]] * 5


def test_a_short_exposure_costs_noise(taken):
    (finding,) = check_light(taken(full_dn=30.0), SCALE)
    assert finding.name == "too little light"
    assert finding.evidence["brightest_share"] == pytest.approx(30 / 255, rel=0.15)
    longer, shorter = (taken(full_dn=dn).sigma_rad for dn in (0.8 * 255, 30.0))
    assert finding.effect_rad == pytest.approx(shorter - longer, rel=0.1)


def test_light_that_no_fringe_modulates_costs_noise(taken):
    (finding,) = check_light(taken(full_dn=60.0, ambient_dn=140.0), SCALE)
    assert finding.name == "low contrast"
    assert finding.evidence["contrast"] == pytest.approx(30 / 170, rel=0.05)


def test_where_nothing_changes_there_are_no_fringes(taken):
    assert names(check_light(taken(full_dn=0.0, ambient_dn=100.0), SCALE)) == ["no fringes"]


def test_lit_parts_with_weak_fringes_are_low_in_modulation(taken, paint):
    stack = paint()
    weak = paint(full_dn=2.0, ambient_dn=90.0)
    stack[:, :, :40] = weak[:, :, :40]
    found = check_light(taken(stack), SCALE)
    assert "low modulation" in names(found)
    assert found[-1].evidence["weak_share"] == pytest.approx(0.25, rel=0.1)
