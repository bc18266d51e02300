"""Camera path, projector path and both together: derivatives against differences, inverses against forward models."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from greenough.instrument.errors import InputError
from greenough.pipeline.camera_model import CameraModel
from greenough.pipeline.imaging_path import ImagingPath
from greenough.pipeline.instrument_model import InstrumentModel
from greenough.pipeline.legendre_field import DepthField
from greenough.pipeline.projector_model import ProjectorModel, fit_row, projector_picture

ROW = np.array([159.0, 29.2, 0.4, 3.1, 4.6e-4, 1e-5, -4.4e-3])
STEPS = 1e-5


def made(seed=3) -> InstrumentModel:
    rng = np.random.default_rng(seed)
    camera = CameraModel(22683.0, 22700.0, -1.0, 645.0, 470.0, -1.0, 0.0, -0.004, 0.003, (960, 1280))
    look = np.eye(4)
    look[:3, :3] = Rotation.from_euler("y", 6, degrees=True).as_matrix() @ np.diag([1.0, -1.0, -1.0])
    look[:3, 3] = [0.1, -0.2, 224.56]
    seen = DepthField((0.0, 0.0), (0.029, 0.022), (1, 5), (1, 4), 1.5)
    lit = DepthField((159.0, 0.0), (170.0, 3.2), (0, 6), (0, 4), 1.5)
    coefficients = rng.normal(0, 0.05, (2, len(seen.orders)))
    projector = ProjectorModel(ROW, lit, rng.normal(0, 0.05, len(lit.orders)))
    count = 6 + coefficients.size + len(lit.orders)
    factor = rng.normal(0, 1e-5, (count, count))
    return InstrumentModel(ImagingPath(camera, look, seen, coefficients), projector, factor @ factor.T)


def volume(rng, count=60):
    return rng.uniform([-4.5, -2.8, -1.4], [4.5, 2.8, 1.4], (count, 3))


def differences(function, size, step):
    """Central differences (..., size) of a function of a step (size,)."""
    columns = [(function(step * unit) - function(-step * unit)) / (2 * step) for unit in np.eye(size)]
    return np.stack(columns, axis=-1)


def assert_close(found, expected):
    """To a millionth of each column's largest entry, or of all of them where a column is zero."""
    scale = np.abs(expected).max(axis=tuple(range(expected.ndim - 1))) + 1e-6 * np.abs(expected).max()
    assert np.all(np.abs(found - expected) <= 2e-6 * scale)


@pytest.mark.parametrize("path", ["camera", "projector"])
def test_derivatives_by_the_point_are_those_of_the_path(path):
    model, xyz = getattr(made(), path), volume(np.random.default_rng(1))
    forward = model.project if path == "camera" else model.phase
    value, by_point, _ = model.linearise(xyz)
    np.testing.assert_allclose(value, forward(xyz), atol=1e-10)
    assert_close(by_point, differences(lambda step: forward(xyz + step), 3, 1e-4))


def test_derivatives_by_the_row_are_those_of_the_phase():
    projector, xyz = made().projector, volume(np.random.default_rng(12))

    def phase(step):
        return replace(projector, row=projector.row + step).phase(xyz)

    assert_close(projector.by_row(xyz), differences(phase, 7, 1e-6))


@pytest.mark.parametrize("path", ["camera", "projector"])
def test_derivatives_by_the_parameters_are_those_of_moved(path):
    model, xyz = getattr(made(), path), volume(np.random.default_rng(2))
    _, _, by_parameters = model.linearise(xyz)

    def forward(step):
        moved = model.moved(step)
        return moved.project(xyz) if path == "camera" else moved.phase(xyz)

    assert_close(by_parameters, differences(forward, by_parameters.shape[-1], STEPS))


def test_points_lie_on_their_rays_and_heights():
    model, rng = made(), np.random.default_rng(4)
    xyz = volume(rng)
    np.testing.assert_allclose(model.points(model.camera.project(xyz), xyz[:, 2]), xyz, atol=1e-8)


def test_points_lie_on_their_rays_and_on_a_surface():
    model = made()
    pixels = np.random.default_rng(5).uniform([100, 100], [1180, 860], (50, 2))
    xyz = model.points(pixels, lambda xy: 0.3 + 0.05 * xy[:, 0] - 0.02 * xy[:, 1] ** 2)
    np.testing.assert_allclose(model.camera.project(xyz), pixels, atol=1e-6)
    np.testing.assert_allclose(xyz[:, 2], 0.3 + 0.05 * xyz[:, 0] - 0.02 * xyz[:, 1] ** 2, atol=1e-9)


def test_sensitivity_keeps_pixel_and_phase():
    """A point moved along with the parameters has the pixel and the phase it had, to second order."""
    model, xyz = made(), volume(np.random.default_rng(6), 20)
    step = np.random.default_rng(7).normal(0, 1e-6, model.parameters)
    moved, there = model.moved(step), xyz + model.sensitivity(xyz) @ step
    np.testing.assert_allclose(moved.camera.project(there), model.camera.project(xyz), atol=1e-8)
    np.testing.assert_allclose(moved.projector.phase(there), model.projector.phase(xyz), atol=1e-8)
    without = np.abs(moved.camera.project(xyz) - model.camera.project(xyz)).max()
    assert without > 1e-5


def test_covariance_of_points_is_that_of_drawn_parameters():
    """4000 draws: each variance is known to sqrt(2 / 4000) = 2.2 %, five of them are allowed."""
    model, xyz = made(), volume(np.random.default_rng(8), 3)
    factor = np.linalg.cholesky(model.covariance + 1e-16 * np.eye(model.parameters))
    steps = np.random.default_rng(9).normal(size=(4000, model.parameters)) @ factor.T
    moved = (model.sensitivity(xyz).reshape(9, -1) @ steps.T).var(axis=1)
    np.testing.assert_allclose(moved, np.diag(model.point_covariance(xyz)), rtol=0.11)


def test_a_row_is_found_from_its_phases():
    xyz = volume(np.random.default_rng(10), 300)
    np.testing.assert_allclose(fit_row(xyz, projector_picture(ROW, xyz)[:, 0]), ROW, rtol=1e-7, atol=1e-9)


def test_points_of_one_plane_do_not_determine_a_row():
    xyz = volume(np.random.default_rng(11), 300)
    xyz[:, 2] = 0.0
    with pytest.raises(InputError, match="do not determine the projector: tilt the board"):
        fit_row(xyz, projector_picture(ROW, xyz)[:, 0])
