"""Uncertainty of points by their calibration: against the model's own covariance, and the paper's against refits."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from greenough.instrument.contract import KnownUncertainty
from greenough.pipeline.calibration_uncertainty import (
    GRID,
    CalibrationUncertainty,
    essential,
    grid_nodes,
    uncertainty_of_model,
)
from greenough.pipeline.camera_model import CameraModel
from greenough.pipeline.imaging_path import ImagingPath
from greenough.pipeline.instrument_model import InstrumentModel
from greenough.pipeline.legendre_field import DepthField
from greenough.pipeline.projector_model import ProjectorModel

NOTHING = KnownUncertainty(0.0, 0.0, 0.0)


@pytest.fixture(scope="module")
def model() -> InstrumentModel:
    """A pinhole 224.56 mm above the field and a projector beside it, whose parameters are known to some per mille."""
    camera = CameraModel(2835.0, 2835.0, 0.0, 79.5, 59.5, 0.0, 0.0, 0.0, 0.0, (120, 160))
    look = np.diag([1.0, -1.0, -1.0, 1.0])
    look[2, 3] = 224.56
    seen, lit = (
        DepthField(centre, half, (1, 3), (1, 2), 1.5) for centre, half in (((0, 0), (0.03, 0.02)), ((159, 0), (170, 3)))
    )
    rng = np.random.default_rng(2)
    count = 6 + 2 * len(seen.orders) + len(lit.orders)
    factor = 1e-4 * rng.normal(size=(count, count))
    row = np.array([159.0, 29.2, 0.4, 6.1, 4.6e-4, 1e-5, -4.4e-3])
    return InstrumentModel(
        ImagingPath(camera, look, seen, np.zeros((2, len(seen.orders)))),
        ProjectorModel(row, lit, np.zeros(len(lit.orders))),
        factor @ factor.T,
    )


def test_at_the_nodes_the_covariance_is_the_models(model):
    """Single points, and what two of them have in common."""
    uncertainty = uncertainty_of_model(model, -1.4, 1.4, NOTHING, 0.0)
    _, pixels, z = grid_nodes(model.camera.camera.shape, -1.4, 1.4)
    some = np.random.default_rng(1).choice(len(z), 5, replace=False)
    expected = model.point_covariance(model.points(pixels[some], z[some]))
    moved = uncertainty.displacements(pixels[some], z[some]).reshape(15, -1)
    np.testing.assert_allclose(moved @ moved.T, expected, atol=1e-4 * expected.max())
    own = uncertainty.covariance(pixels[some], z[some])
    blocks = [expected[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] for k in range(5)]
    np.testing.assert_allclose(own, blocks, atol=1e-4 * expected.max())


def test_between_the_nodes_it_departs_by_a_few_per_cent(model):
    uncertainty = uncertainty_of_model(model, -1.4, 1.4, NOTHING, 0.0)
    rng = np.random.default_rng(3)
    pixels, z = rng.uniform([0, 0], [159, 119], (40, 2)), rng.uniform(-1.4, 1.4, 40)
    found = np.sqrt(np.diagonal(uncertainty.covariance(pixels, z), axis1=1, axis2=2))
    expected = np.sqrt(np.diag(model.point_covariance(model.points(pixels, z)))).reshape(40, 3)
    assert np.abs(found / expected - 1).max() < 0.1


def test_the_boards_scale_lengthens_everything_and_the_tables_drift_nothing(model):
    certain = replace(model, covariance=np.zeros_like(model.covariance))
    known = KnownUncertainty(board_scale=1e-3, table_drift_mm=2e-3, path_drift_mm=0.0)
    uncertainty = uncertainty_of_model(certain, -1.4, 1.4, known, drift_share=0.25)
    pixels = np.array([[30.0, 20.0], [130.0, 100.0]])
    z = np.array([-1.4, 1.4])  # nodes: between them variances are taken to be linear
    moved = uncertainty.displacements(pixels, z)  # (2, 3, k)
    points = certain.points(pixels, z)
    apart = moved[1] - moved[0]
    np.testing.assert_allclose(
        apart @ apart.T, 1e-6 * np.outer(points[1] - points[0], points[1] - points[0]), atol=1e-11
    )
    expected = 1e-6 * points[0, 2] ** 2 + 0.25 * 2e-3**2
    assert uncertainty.covariance(pixels, z)[0, 2, 2] == pytest.approx(expected, rel=1e-3)


@settings(max_examples=25)
@given(st.integers(0, 2**32 - 1), st.integers(1, 40))
def test_fewer_causes_make_the_same_covariances(seed, causes):
    displacements = 1e-3 * np.random.default_rng(seed).normal(size=(int(np.prod(GRID)), 3, causes))
    displacements = np.concatenate([displacements, 2 * displacements, np.zeros_like(displacements)], axis=-1)
    modes = essential(displacements)
    assert len(modes) <= causes
    flat, few = displacements[:30].reshape(90, -1), np.moveaxis(modes, 0, -1).reshape(-1, len(modes))[:90]
    np.testing.assert_allclose(few @ few.T, flat @ flat.T, atol=1e-5 * np.square(flat).sum(axis=1).max())


def test_common_causes_join_and_single_pixels_patterns_count_in_z_alone():
    none = CalibrationUncertainty(
        np.array([-1.0, 1.0]), np.array([0.0, 9.0]), np.array([0.0, 9.0]),
        np.zeros((1, 2, 2, 2, 3), np.float32), np.array([1e-3, 3e-3]),
    )  # fmt: skip
    more = none.joined(np.array([[0.0, 0.0, 4e-3], [1e-3, 0.0, 0.0]]))
    covariance = more.covariance(np.array([[4.0, 4.0]]), np.array([1.0]))[0]
    np.testing.assert_allclose(covariance, np.diag([1e-6, 0.0, 25e-6]), atol=1e-12)
    assert np.isnan(more.covariance(np.array([[4.0, 4.0]]), np.array([np.nan]))).all()
