"""Claims about rows' verdicts and the optical resolution they refer to."""

import pytest


@pytest.mark.slow
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


@pytest.mark.parametrize(("predicted", "expected"), [(3.0, True), (3.8, None), (4.2, None), (-4.2, None), (5.0, False)])
def test_a_prediction_near_its_limit_leaves_open_what_to_expect(analytic, predicted, expected):
    for measured in (3.7, 4.3):
        claim = analytic().claim(
            "depth", "plane", measured, "um", 10, "", limit=4.0, predicted=predicted, predicted_sd=0.1
        )
        assert claim.expected_to_hold is expected
        assert claim.holds is (measured < 4)


def test_a_claim_without_a_prediction_is_never_left_open(analytic):
    claim = analytic().claim("depth", "plane", 4.01, "um", 10, "", limit=4.0, predicted_sd=5.0)
    assert (claim.holds, claim.expected_to_hold, claim.as_expected) == (False, True, False)


def test_a_prediction_that_is_no_number_excuses_nothing(analytic):
    claim = analytic().claim("depth", "plane", 5.0, "um", 1, "", limit=4.0, predicted=float("nan"), predicted_sd=0.1)
    assert (claim.holds, claim.expected_to_hold, claim.predicted, claim.predicted_sd) == (False, True, None, None)


@pytest.mark.parametrize(("predicted", "expected"), [(0.99, True), (0.955, None), (0.9, False)])
def test_a_limit_may_be_a_least_value(analytic, predicted, expected):
    for measured in (0.94, 0.96):
        claim = analytic().claim(
            "share", "plane", measured, "1", 10, "", limit=0.95, at_least=True, predicted=predicted, predicted_sd=0.01
        )
        assert (claim.holds, claim.expected_to_hold) == (measured > 0.95, expected)


def test_a_row_without_a_limit_only_reports(analytic):
    claim = analytic().claim("bias", "coin", 123.0, "um", 10, "", predicted=1.0)
    assert (claim.limit, claim.holds, claim.expected_to_hold, claim.as_expected) == (None, None, None, True)


def test_a_filtered_row_names_the_fit_that_filters(analytic):
    width = analytic().filter_fwhm_px
    assert analytic().filter_name == f"plane under a gaussian on phasors, fwhm {width:.2f} px"
