"""Where spots lie in space: a calibration that takes phases for heights, so that a phase map is a height map."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from greenough.instrument.contract import SpotBoard
from greenough.pipeline.camera_model import CameraModel
from greenough.pipeline.decode import PhaseMap
from greenough.pipeline.metrology.cross_grating import in_plane, mapping_deviation
from greenough.pipeline.rays import rays_of_camera
from greenough.pipeline.spot_points import spot_points
from greenough.pipeline.spots import Spots, detect_spots

CAMERA = CameraModel(22683.0, 22683.0, 0.0, 639.5, 479.5, 0.0, 0.0, 0.0, 0.0, (960, 1280))
PUPIL = np.array([0.0, 0.0, 224.56])
CAMERA_FROM_WORLD = np.diag([1.0, -1.0, -1.0, 1.0]) + np.outer([0, 0, 1, 0], [0, 0, 0, PUPIL[2]])
CALIBRATION: Any = SimpleNamespace(
    phase_height=SimpleNamespace(height=lambda phase: phase), rays=rays_of_camera(CAMERA, CAMERA_FROM_WORLD)
)


def phase_map_of(point: np.ndarray, normal: np.ndarray, background: np.ndarray | None = None) -> PhaseMap:
    """Heights of a plane on every pixel's ray."""
    v, u = np.indices(CAMERA.shape)
    ray = np.stack([(u - CAMERA.cx) / CAMERA.fx, -(v - CAMERA.cy) / CAMERA.fy, -np.ones(u.shape)], axis=-1)
    z = PUPIL[2] - ((point - PUPIL) @ normal) / (ray @ normal)
    nothing = np.zeros(z.shape)
    return PhaseMap(z, nothing, nothing if background is None else background, np.ones(z.shape, bool), nothing, nothing)


def test_spots_of_a_tilted_board_are_found_where_they_are(spot_board):
    turn = Rotation.from_euler("xyz", [8, -11, 25], degrees=True)
    centres = turn.apply(np.column_stack([spot_board.centres(), np.zeros(99)])) + np.array([0.05, 0.02, 0.1])
    phase_map = phase_map_of(centres[0], turn.apply([0, 0, 1]))
    pixels = CAMERA.project(centres @ CAMERA_FROM_WORLD[:3, :3].T + CAMERA_FROM_WORLD[:3, 3])
    axes = np.repeat(spot_board.diameters()[:, None] / 2 * 101, 2, axis=1)
    sigma = np.full(99, 0.01)
    pixels[7] = axes[7] = sigma[7] = np.nan
    points = spot_points(phase_map, Spots(pixels, axes, sigma), CALIBRATION)
    assert np.isnan(points[7]).all()
    inside = (np.abs(pixels - [639.5, 479.5]) < [610, 450]).all(axis=1)
    assert inside.sum() > 80
    # A plane's height is not quite linear in u and v: 0.08 mm spots at 225 mm bend it by far less than a nanometre.
    np.testing.assert_allclose(points[inside], centres[inside], atol=1e-5)


def test_a_grating_of_another_pitch_is_located_and_mapped(paint):
    """Painted, detected, put into space and held against its drawing: deviations are the detection's noise.

    The drawing is 1.0003 times too small, which the scale tells and the deviations do not. 4.5 sd of a mean of 165.
    """
    grating = SpotBoard(11, 15, 0.5, 0.3, 0.15, 9.0, ((5, 7), (5, 8), (4, 7), (5, 4), (8, 9)))
    turn = Rotation.from_euler("xyz", [3, -2, 8], degrees=True)
    camera_from_board = CAMERA_FROM_WORLD.copy()
    camera_from_board[:3, :3] = CAMERA_FROM_WORLD[:3, :3] @ turn.as_matrix()
    intrinsics = (CAMERA.fx, CAMERA.fy, 0.0, CAMERA.cx, CAMERA.cy, 0.0, 0.0, 0.0, 0.0)
    painted = paint(
        grating, camera_from_board, np.random.default_rng(1), intrinsics=intrinsics, lit_field=False,
        centres=1.0003 * grating.centres(),
    )  # fmt: skip
    spots = detect_spots(painted.picture, grating)
    assert spots.seen.all()
    points = spot_points(phase_map_of(np.zeros(3), turn.apply([0, 0, 1])), spots, CALIBRATION)
    found = mapping_deviation(in_plane(points), grating.centres())
    assert found.n == 165
    noise = 0.03 / 101  # mm per coordinate: the small spots' scatter in the picture is below this
    assert found.scale == pytest.approx(1.0003, abs=4.5 * noise / np.sqrt(165) / 1.5)
    assert np.degrees(found.rotation) == pytest.approx(8.0, abs=0.2)  # the tilts turn its axes a little
    assert found.rms < np.sqrt(2) * noise
    assert found.largest < 6 * noise
