"""The four measurands and their intervals: analytic points, and errors drawn from what is stated."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import binom

from greenough.instrument.contract import SpotBoard
from greenough.pipeline.calibration_uncertainty import CalibrationUncertainty
from greenough.pipeline.camera_model import CameraModel
from greenough.pipeline.imaging_path import ImagingPath
from greenough.pipeline.instrument_model import InstrumentModel
from greenough.pipeline.legendre_field import DepthField
from greenough.pipeline.projector_model import ProjectorModel
from greenough.twin.validation.coverage import (
    Captures,
    Points,
    height_at_origin,
    holds,
    mean_distance,
    measured,
    noise_of_spots,
    plane_height,
    points_of,
)

BOARD = SpotBoard(3, 4, 0.65, 0.4, 0.175, 8.0, ())
RADIUS_MM, OFFSET_MM, NOISE_MM, WALK_MM = 1.0, 4e-4, 5e-4, 3e-4


def model():
    pose = np.diag([1.0, -1.0, -1.0, 1.0])
    pose[2, 3] = 224.56
    camera = CameraModel(22683.0, 22683.0, 0.0, 640.0, 480.0, 0.0, 0.0, 0.0, 0.0, (960, 1280))
    field = DepthField((0.0, 0.0), (1.0, 1.0), (1, 2), (1, 2), 1.5)
    path = ImagingPath(camera, pose, field, np.zeros((2, len(field.orders))))
    row = np.array([160.0, 29.4, 0.1, 6.1, 0.0, 0.0, 0.004])
    return InstrumentModel(path, ProjectorModel(row, field, np.zeros(len(field.orders))), np.empty(0))


def offset_of_all(sd):
    """One cause: all points go up together."""
    modes = np.zeros((1, 2, 2, 2, 3), dtype=np.float32)
    modes[0, ..., 2] = sd
    ends = np.array([-2.0, 2.0]), np.array([0.0, 960.0]), np.array([0.0, 1280.0])
    return CalibrationUncertainty(*ends, modes, np.zeros(2))


def captures(rng, stated=1.0):
    """Points with errors of the sizes above, and ``stated`` times as much stated."""
    uncertainty = offset_of_all(stated * OFFSET_MM)
    offset = np.array([0.0, 0.0, OFFSET_MM * rng.standard_normal()])
    x, y = (grid.ravel() for grid in np.meshgrid(np.linspace(-3, 3, 9), np.linspace(-2, 2, 7)))

    def points(xyz, walk=0.0):
        moved = xyz + offset + [0.0, 0.0, walk] + NOISE_MM * rng.standard_normal(xyz.shape)
        noise = np.tile(stated * NOISE_MM * np.eye(3), (len(xyz), 1, 1))
        return Points(moved, np.tile([640.0, 480.0], (len(xyz), 1)), noise, uncertainty)

    heights = (0.7, -1.25, 1.25)
    planes = [points(np.column_stack([x, y, z + 0.01 * x])) for z in heights[:2]]
    planes.append(points(np.column_stack([x, y, heights[2] + 0.01 * x]), WALK_MM * rng.standard_normal()))
    cap = 0.2 * np.column_stack([x, y])
    ball = points(np.column_stack([cap, np.sqrt(RADIUS_MM**2 - np.sum(cap**2, axis=1))]))
    printed = np.column_stack([BOARD.centres(), np.zeros(12)])
    spots = points(printed)
    spots.xyz[5] = np.nan  # unseen
    return Captures(tuple(planes), heights, stated * WALK_MM, ball, 2 * RADIUS_MM, spots, printed, BOARD)


def hits(stated, draws=60):
    found = []
    for seed in range(draws):
        rng = np.random.default_rng(seed)
        found.append([holds(estimate, true) for estimate, true in measured(captures(rng, stated), rng)])
    return np.sum(found, axis=0)


@pytest.mark.slow
def test_intervals_hold_as_often_as_they_say_when_errors_are_as_stated():
    """Four counts of 60: a right program fails once in 1e5 runs."""
    assert hits(1.0).min() >= binom.ppf(1e-5 / 4, 60, 0.95)


@pytest.mark.slow
def test_intervals_of_half_the_length_hold_less_often():
    """Each measurand's by itself hold 67 % of the time: one of them more often than this once in 1e5 runs."""
    limit = binom.isf(1e-5 / 4, 60, 0.6729)
    assert hits(0.5).max() <= limit < 57


def test_a_height_is_that_of_the_plane_over_the_origin():
    x, y = np.random.default_rng(1).uniform(-3, 3, (2, 50))
    assert height_at_origin(np.column_stack([x, y, 0.4 + 0.1 * x - 0.2 * y])) == pytest.approx(0.4, abs=1e-12)
    tilted = np.eye(4)
    tilted[:3, :3] = [[0.8, 0.0, -0.6], [0.0, 1.0, 0.0], [0.6, 0.0, 0.8]]  # z = 0.75 x
    tilted[:3, 3] = [1.0, 2.0, 3.0]
    assert plane_height(tilted) == pytest.approx(3.0 - 0.75)


def test_a_mean_distance_is_that_of_the_pairs():
    points = np.array([[0.0, 0.0, 0.0], [3.0, 4.0, 0.0], [3.0, 4.0, 12.0]])
    assert mean_distance(points, np.array([[0, 1], [1, 2]])) == pytest.approx((5 + 12) / 2)


def test_points_are_where_pixels_and_phases_say_and_noise_moves_them_there():
    instrument = model()
    xyz = np.random.default_rng(2).uniform([-3, -2, -1.4], [3, 2, 1.4], (20, 3))
    pixels, phase = instrument.camera.project(xyz), instrument.projector.phase(xyz)
    phase[3] = np.nan
    found = points_of(instrument, pixels, phase)
    assert np.isnan(found[3]).all()
    seen = np.arange(20) != 3
    np.testing.assert_allclose(found[seen], xyz[seen], atol=1e-9)
    noise = noise_of_spots(instrument, xyz, np.full(20, 1e-3), np.full(20, 1e-4))
    moved = points_of(instrument, pixels + np.array([1e-3, 0.0]), phase)
    np.testing.assert_allclose((moved - found)[seen], noise[seen, :, 0], rtol=1e-3, atol=1e-12)
    moved = points_of(instrument, pixels, phase + 1e-4)
    np.testing.assert_allclose((moved - found)[seen], noise[seen, :, 2], rtol=1e-3, atol=1e-12)


def test_points_that_were_not_measured_are_left_out():
    points = captures(np.random.default_rng(3)).spots
    noise = points.noise.copy()
    noise[0] = np.nan
    assert len(replace(points, noise=noise).seen.xyz) == 10
