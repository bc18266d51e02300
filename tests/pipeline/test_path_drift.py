"""The walk against walks that are drawn, and what a shift does to points against the global model's own slopes."""

import numpy as np

from greenough.instrument.contract import KnownUncertainty, Procedure
from greenough.pipeline.camera_model import CameraModel
from greenough.pipeline.imaging_path import ImagingPath
from greenough.pipeline.instrument_model import InstrumentModel
from greenough.pipeline.legendre_field import DepthField
from greenough.pipeline.path_drift import along_ray_per_shift, walk_covariance, walked_mm
from greenough.pipeline.pixel_maps import model_maps
from greenough.pipeline.projector_model import ProjectorModel

KNOWN = KnownUncertainty(board_scale=0.0, table_drift_mm=0.0, path_drift_mm=2e-3)
PROCEDURE = Procedure((608.0, 12.0), (4, 12), postures=4, planes=6, plane_step_mm=0.1, exposure_share=0.8)


def test_walks_of_independent_steps_have_this_covariance():
    """2000 walks of 160 steps: a covariance of two unit variables is known to 13 % (4 sd, 1.4 for a variance)."""
    assert PROCEDURE.exposures == 160
    steps = np.random.default_rng(1).standard_normal((2000, 160)) * 2e-3 / np.sqrt(160)
    at = np.array([16, 48, 160])
    walks = np.cumsum(steps, axis=1)[:, at - 1]
    expected = walk_covariance(KNOWN, PROCEDURE, at)
    sizes = np.sqrt(np.diag(expected))
    np.testing.assert_allclose((walks.T @ walks / 2000 - expected) / np.outer(sizes, sizes), 0, atol=0.13)
    np.testing.assert_allclose(sizes, [walked_mm(KNOWN, PROCEDURE, exposures) for exposures in at])
    assert walked_mm(KNOWN, PROCEDURE, 160) == KNOWN.path_drift_mm


def test_a_shift_of_the_fringes_lifts_points_along_their_rays():
    """By what the model's slopes of pixel and phase say: a point keeps to its pixel, and its phase changes."""
    pose = np.diag([1.0, -1.0, -1.0, 1.0])
    pose[:3, 3] = [-20.0, 1.0, 224.56]
    camera = CameraModel(11340.0, 11340.0, 0.0, 1089.5, 72.0, 0.0, 0.0, 0.0, 0.0, (120, 160))
    field = DepthField((0.0, 0.0), (1.0, 1.0), (1, 2), (1, 2), 1.5)
    row = np.array([160.0, 29.4, 3.0, 6.1, 0.0, 0.0, 0.004])
    model = InstrumentModel(
        ImagingPath(camera, pose, field, np.zeros((2, len(field.orders)))),
        ProjectorModel(row, field, np.zeros(len(field.orders))),
        np.empty(0),
    )
    middle = model.points(np.array([[79.5, 59.5]]), np.zeros(1))
    _, pixel_by_point, _ = model.camera.linearise(middle)
    _, phase_by_point, _ = model.projector.linearise(middle)
    slopes = np.concatenate([pixel_by_point[0], phase_by_point])
    expected = np.linalg.solve(slopes, [0.0, 0.0, np.hypot(*phase_by_point[0, :2])])
    assert np.abs(expected[0]) > 0.2
    np.testing.assert_allclose(along_ray_per_shift(*model_maps(model, -1.4, 1.4)), expected, rtol=3e-3, atol=1e-3)
