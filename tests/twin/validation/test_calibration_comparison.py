"""Figures of a comparison from planes whose errors are made up."""

from dataclasses import replace

import numpy as np
import pytest

from greenough.instrument.contract import Procedure
from greenough.pipeline.acquisition import METHODS
from greenough.twin.validation.calibration_comparison import (
    POSTURE_S,
    STAGE_MOVE_S,
    TURN_OVER_S,
    PlaneErrors,
    figures_of,
    without_frame,
)

PROCEDURE = Procedure((608.0, 12.0), (4, 12), postures=16, planes=30, plane_step_mm=0.1, exposure_share=0.8)
EXPOSURES_US = [50_000.0] * 16 + [10_000.0] * 31
X, Y = (grid.ravel() for grid in np.meshgrid(np.linspace(-4, 4, 20), np.linspace(-3, 3, 15)))
HEIGHTS = (-1.25, 0.0, 1.25)
SLOPES = ((0.25, 0.0), (0.0, -0.2), (-0.15, 0.15))


def plane(height, slope, errors) -> PlaneErrors:
    """One method's errors (x, y, z) -> (n, 3) on a plane."""
    places = np.column_stack([X, Y, height + np.column_stack([X, Y]) @ slope])
    return PlaneErrors(places, np.asarray(slope), errors(places, np.asarray(slope))[None])


def figures(errors, method="stage-free", change=lambda planes: planes):
    flat = [plane(height, (0.0, 0.0), errors) for height in HEIGHTS]
    tilted = [plane(0.0, slope, errors) for slope in SLOPES]
    return figures_of(method, 0, change(flat), tilted, PROCEDURE, EXPOSURES_US)


def nothing(places, slope):
    return np.zeros_like(places)


def moved(places, slope):
    """By 1 to 3 µm and 0.2 to 0.5 mrad: what a point's z then is off its tilted plane by."""
    shift = np.array([1e-3, -2e-3, 3e-3]) + np.cross([0.5e-3, -0.3e-3, 0.2e-3], places)
    shift[:, 2] -= shift[:, :2] @ slope
    return shift


def test_a_rigid_motion_is_an_origin_and_no_error_of_the_volume():
    found = figures(moved)
    assert found.origin_um == pytest.approx(3.0, abs=0.7)
    assert max(found.z_rms_um, found.z_p99_um, found.xy_rms_um) < 1e-6
    assert found.flatness_um < 1e-6


def test_a_wrong_scale_of_heights_is_an_error_of_the_step():
    """By 1 per mille: 2.5 µm of 2.5 mm everywhere; no rigid motion takes it away."""

    def stretched(places, slope):
        return np.column_stack([0 * X, 0 * X, 1e-3 * places[:, 2]])

    found = figures(stretched)
    assert found.step_um == pytest.approx(2.5)
    assert found.step_local_um == pytest.approx(2.5)
    assert found.flatness_um < 1e-9
    assert found.z_rms_um > 0.4


def test_what_changes_from_place_to_place_is_local_and_bends_planes():
    """x z: no change of the mean step, but one of each place's, and a twist of the volume that leaves planes flat."""

    def twisted(places, slope):
        return np.column_stack([0 * X, 0 * X, 1e-3 * places[:, 0] * places[:, 2]])

    found = figures(twisted)
    assert found.step_um == pytest.approx(0, abs=1e-9)
    assert found.step_local_um == pytest.approx(2.5 * np.sqrt(np.mean(X**2)))
    assert found.flatness_um < 1e-9

    def bent(places, slope):
        return np.column_stack([0 * X, 0 * X, 1e-4 * places[:, 1] ** 2])

    assert figures(bent).flatness_um == pytest.approx(0.1 * np.std(Y**2))
    assert figures(bent).step_local_um == pytest.approx(0, abs=1e-9)


def test_methods_are_judged_where_all_of_them_measure():
    """The other method measures a half of the field; there this one is right."""

    def wrong_on_the_right(places, slope):
        return np.where(X[:, None] > 0, 1.0, 0.0) * np.ones(3)

    def half(planes):
        other = np.where(X[:, None] > 0, np.nan, 0.0) * np.ones(3)
        return [replace(each, errors=np.stack([each.errors[0], other])) for each in planes]

    flat = half([plane(height, (0.0, 0.0), wrong_on_the_right) for height in HEIGHTS])
    tilted = half([plane(0.0, slope, wrong_on_the_right) for slope in SLOPES])
    this, other = (figures_of("bundle", k, flat, tilted, PROCEDURE, EXPOSURES_US) for k in range(2))
    assert this.z_rms_um == this.origin_um == this.step_local_um == 0
    assert (this.measured_share, other.measured_share) == (1.0, 0.5)


def test_places_that_are_not_lit_count_for_nobody():
    def dark(planes):
        places, errors = planes[1].places.copy(), planes[1].errors.copy()
        places[:150], errors[:, :150] = np.nan, np.nan
        return [planes[0], replace(planes[1], places=places, errors=errors), planes[2]]

    assert figures(nothing, change=dark).measured_share == 1.0


def test_without_a_common_place_nothing_is_known():
    def lost(planes):
        return [replace(each, errors=np.full_like(each.errors, np.nan)) for each in planes]

    tilted = lost([plane(0.0, slope, nothing) for slope in SLOPES])
    flat = lost([plane(height, (0.0, 0.0), nothing) for height in HEIGHTS])
    found = figures_of("paper", 0, flat, tilted, PROCEDURE, EXPOSURES_US)
    assert np.isnan([found.origin_um, found.z_rms_um, found.z_p99_um, found.xy_rms_um, found.step_um]).all()
    assert np.isnan([found.step_local_um, found.flatness_um]).all()
    assert found.measured_share == 0


@pytest.mark.parametrize("method", METHODS)
def test_effort_is_that_of_the_method_alone(method):
    found = figures(nothing, method)
    if METHODS[method].needs_planes:
        assert (found.captures, found.hand_actions, found.stage_moves) == (47, 17, 31)
        frames_s = 16 * (16 * 0.05 + 31 * 0.01)
        hands_s = 16 * POSTURE_S + TURN_OVER_S + 31 * STAGE_MOVE_S
    else:
        assert (found.captures, found.hand_actions, found.stage_moves) == (16, 16, 0)
        frames_s, hands_s = 16 * 16 * 0.05, 16 * POSTURE_S
    assert found.rig_min == pytest.approx((frames_s + hands_s) / 60)


def test_the_frame_is_found_from_errors_of_tilted_planes_too():
    """A motion along x alone moves no flat plane, but every one that leans along x."""
    places = np.column_stack([X, Y, 0.25 * X])
    errors = np.broadcast_to([1e-3, 0.0, -0.25e-3], places.shape)
    assert np.abs(without_frame([errors], [places], [np.array([0.25, 0.0])])).max() < 1e-12
