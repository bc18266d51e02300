"""Claims about rows' verdicts and the optical resolution they refer to."""

import pytest


def test_airy_radius_is_that_of_the_aperture_in_pixels_at_the_specimen(analytic):
    # 0.61 wavelengths over the aperture's sine, on pixels of 224.56 mm / 22683.
    expected = 0.6098 * 0.525e-3 / 0.015 / (224.56 / 22683)
    assert analytic().airy_radius_px == pytest.approx(expected, rel=1e-3)
    assert analytic().filter_fwhm_px == 2 * analytic().airy_radius_px


@pytest.mark.parametrize(("measured", "holds"), [(3.9, True), (-3.9, True), (4.1, False), (-4.1, False)])
def test_a_limit_bounds_the_absolute_value(analytic, measured, holds):
    claim = analytic().claim("depth", "plane", measured, "um", 10, "", limit=4.0)
    assert (claim.holds, claim.expected_to_hold, claim.seed, claim.calibration) == (holds, True, 5, "paper")


@pytest.mark.parametrize(("predicted", "expected"), [(3.0, True), (5.0, False)])
def test_the_prediction_decides_what_is_expected_and_the_measurement_does_not(analytic, predicted, expected):
    for measured in (1.0, 9.0):
        claim = analytic().claim("depth", "plane", measured, "um", 10, "", limit=4.0, predicted=predicted)
        assert claim.expected_to_hold is expected


def test_a_row_without_a_limit_only_reports(analytic):
    claim = analytic().claim("bias", "coin", 123.0, "um", 10, "", predicted=1.0)
    assert (claim.limit, claim.holds, claim.expected_to_hold, claim.as_expected) == (None, None, None, True)
