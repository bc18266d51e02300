"""The bundle's equations against differences: every unknown moves every observation as its column says."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from greenough.pipeline.bundle_data import BundleData, PlaneBlocks, SpotPhases
from greenough.pipeline.bundle_rows import plane_rows, posture_rows
from greenough.pipeline.bundle_state import BoardShape, BundleState, Layout
from greenough.pipeline.camera_model import CameraModel
from greenough.pipeline.imaging_path import ImagingPath
from greenough.pipeline.instrument_model import InstrumentModel
from greenough.pipeline.legendre_field import DepthField
from greenough.pipeline.projector_model import ProjectorModel
from greenough.pipeline.spots import Spots

REFERENCE = 1


@pytest.fixture(scope="module")
def problem(spot_board):
    """State, layout, board and observations; three postures, the middle one flat, and two planes."""
    rng = np.random.default_rng(1)
    # Spots without size: how the ellipse's offset, some thousandths of a px, changes with the pose is left out.
    board = replace(BoardShape.of(spot_board), radii=np.zeros(len(spot_board.centres())))
    count = len(board.nominal)
    camera = CameraModel(22683.0, 22700.0, -1.0, 645.0, 470.0, -1.0, 0.0, -0.004, 0.003, (960, 1280))
    look = np.eye(4)
    look[:3, :3] = Rotation.from_euler("y", 6, degrees=True).as_matrix() @ np.diag([1.0, -1.0, -1.0])
    look[:3, 3] = [0.0, 0.0, 224.56]
    seen = DepthField((0.0, 0.0), (0.029, 0.022), (1, 3), (1, 2), 1.5)
    lit = DepthField((159.0, 0.0), (170.0, 3.2), (0, 3), (0, 2), 1.5)
    instrument = InstrumentModel(
        ImagingPath(camera, look, seen, rng.normal(0, 0.02, (2, len(seen.orders)))),
        ProjectorModel(
            np.array([159.0, 29.2, 0.4, 3.1, 4.6e-4, 1e-5, -4.4e-3]), lit, rng.normal(0, 0.02, len(lit.orders))
        ),
        np.empty(0),
    )
    poses = np.tile(np.eye(4), (3, 1, 1))
    for k, tilt in ((0, [0.2, -0.15, 1.5]), (2, [-0.1, 0.3, 3.0])):
        poses[k, :3, :3] = Rotation.from_rotvec(tilt).as_matrix()
        poses[k, :3, 3] = rng.uniform(-0.5, 0.5, 3)
    state = BundleState(
        instrument=instrument,
        print_mm=rng.normal(0, 1e-3, (count, 2)),
        bow_mm=rng.normal(0, 1e-3, 3),
        world_from_board=poses,
        planes=np.array([[-1.2, 0.01, -0.005], [0.9, -0.004, 0.008]]),
        shape_mm=rng.normal(0, 5e-3, 3),
        offsets_rad=rng.normal(0, 1e-3, 3),
    )
    layout = Layout(instrument.parameters, count, 3, 2, REFERENCE)
    # As measured: what the state says, somewhat off.
    found, phases = [], []
    for pose in poses:
        xyz = state.spots(board) @ pose[:3, :3].T + pose[:3, 3]
        centres = instrument.camera.project(xyz) + rng.normal(0, 0.05, (count, 2))
        found.append(Spots(centres, np.full((count, 2), 9.0), np.full(count, 0.01)))
        gradient = rng.normal([0.29, 0.0], 0.02, (count, 2))
        phases.append(SpotPhases(instrument.projector.phase(xyz), gradient, np.full(count, 1e-3)))
    pixels = rng.uniform([100, 150], [1180, 810], (40, 2))
    planes = tuple(PlaneBlocks(pixels + k, np.full(40, 150.0)) for k in range(2))
    return state, layout, board, BundleData(tuple(found), tuple(phases), planes)


@pytest.mark.parametrize(
    ("rows", "k"), [(posture_rows, 0), (posture_rows, 1), (posture_rows, 2), (plane_rows, 0), (plane_rows, 1)]
)
def test_derivatives_are_differences_of_the_residuals(problem, rows, k):
    state, layout, board, data = problem
    result = rows(state, layout, board, data, k)
    step = 1e-5
    for column, found in zip(result.columns, result.jacobian.T, strict=True):
        ahead, behind = (
            rows(layout.moved(state, sign * step * np.eye(layout.size)[column]), layout, board, data, k).residual
            for sign in (1, -1)
        )
        expected = -(ahead - behind) / (2 * step)  # measured minus modelled
        assert np.abs(found - expected).max() <= 1e-6 * np.abs(expected).max() + 1e-5


def test_every_unknown_that_moves_an_observation_has_a_column(problem):
    """A random step of all unknowns moves the residuals as the columns that are there say."""
    state, layout, board, data = problem
    step = np.random.default_rng(2).normal(0, 1e-6, layout.size)
    moved = layout.moved(state, step)
    parts = [(posture_rows, k) for k in range(3)] + [(plane_rows, k) for k in range(2)]
    used = set()
    for rows, k in parts:
        result = rows(state, layout, board, data, k)
        change = rows(moved, layout, board, data, k).residual - result.residual
        expected = -result.jacobian @ step[result.columns]
        assert np.abs(change - expected).max() < 1e-3 * np.abs(expected).max()
        used.update(result.columns)
    assert used == set(range(layout.size))


def test_the_flat_posture_has_no_unknowns(problem):
    state, layout, _, _ = problem
    assert layout.posture(REFERENCE).start == layout.posture(REFERENCE).stop
    moved = layout.moved(state, np.full(layout.size, 1e-3))
    assert np.array_equal(moved.world_from_board[REFERENCE], np.eye(4))


def test_the_phase_does_not_depend_on_where_in_the_spot_it_was_taken(problem):
    """A centre found elsewhere comes with the phase of elsewhere: the comparison stays the same."""
    state, layout, board, data = problem
    before = posture_rows(state, layout, board, data, 0).residual.reshape(-1, 3)
    shift = np.array([0.3, -0.2])
    found, measured = data.spots[0], data.phases[0]
    elsewhere = replace(
        data,
        spots=(replace(found, centres_px=found.centres_px + shift), *data.spots[1:]),
        phases=(replace(measured, phase_rad=measured.phase_rad + measured.gradient_rad @ shift), *data.phases[1:]),
    )
    after = posture_rows(state, layout, board, elsewhere, 0).residual.reshape(-1, 3)
    np.testing.assert_allclose(after[:, 2], before[:, 2], atol=1e-9)
    np.testing.assert_allclose(after[:, :2], before[:, :2] + shift, atol=1e-9)


def test_the_bow_neither_lifts_nor_tilts_the_board(spot_board):
    board = BoardShape.of(spot_board)
    plane = np.column_stack([np.ones(len(board.nominal)), board.nominal])
    np.testing.assert_allclose(plane.T @ board.bow_terms, 0.0, atol=1e-10)
