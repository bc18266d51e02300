from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from greenough.pipeline.camera_model import CameraModel

PAPER = CameraModel(
    22683.6612, 22760.4770, -0.9944, 633.3725, 520.4101, -0.09531, 0.02512, -0.00869, -0.00273, (960, 1280)
)
WIDE = CameraModel(800.0, 810.0, 0.0, 320.0, 240.0, -0.2, 0.05, 0.003, -0.002, (480, 640))


def test_projection_agrees_with_opencv():
    xyz = np.random.default_rng(1).uniform([-3, -2, 5], [3, 2, 8], (200, 3))
    expected, _ = cv2.projectPoints(
        xyz, np.zeros(3), np.zeros(3), WIDE.camera_matrix, np.array([WIDE.k1, WIDE.k2, WIDE.p1, WIDE.p2])
    )
    assert WIDE.project(xyz) == pytest.approx(expected[:, 0], abs=1e-9)


def test_skew_adds_its_share_of_y_to_u():
    xyz = np.array([[0.4, -0.3, 2.0]])
    difference = replace(WIDE, skew=7.0).project(xyz) - WIDE.project(xyz)
    distorted_y = (WIDE.project(xyz)[0, 1] - WIDE.cy) / WIDE.fy
    assert difference[0] == pytest.approx([7.0 * distorted_y, 0.0], abs=1e-12)


def test_skew_angle_of_the_paper():
    """Section 4.1: arctan(f_C1 / γ_c) is about 90.0025°."""
    assert PAPER.skew_angle_deg == pytest.approx(90.0025, abs=5e-5)


@pytest.mark.parametrize("camera", [PAPER, WIDE])
@given(u=st.floats(0, 1), v=st.floats(0, 1))
def test_undistortion_inverts_distortion(camera, u, v):
    uv = np.array([[u * (camera.shape[1] - 1), v * (camera.shape[0] - 1)]])
    assert camera.pixels(camera.normalised(uv)) == pytest.approx(uv, abs=1e-8)


def test_undistortion_keeps_the_shape_of_a_picture():
    uv = np.stack(np.meshgrid(np.arange(40.0), np.arange(30.0)), axis=-1)
    assert PAPER.normalised(uv).shape == (30, 40, 2)
    assert PAPER.pixels(PAPER.normalised(uv)) == pytest.approx(uv, abs=1e-8)


def test_where_distortion_folds_the_picture_over_there_is_no_ray():
    """x (1 - x²) never exceeds 0.385."""
    folded = CameraModel(100.0, 100.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0, (100, 100))
    rays = folded.normalised(np.array([[38.0, 0.0], [39.0, 0.0]]))
    assert np.isfinite(rays[0]).all()
    assert np.isnan(rays[1]).all()


def test_eccentricity_on_the_axis_is_the_closed_form():
    """f r² sin t cos t / (Z² - r² sin² t) for a circle tilted by t on the axis, towards its nearer side."""
    tilt, radius, distance = 0.5, 2.0, 10.0
    camera = CameraModel(1000.0, 1000.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, (100, 100))
    pose = np.eye(4)
    pose[:3, :3] = cv2.Rodrigues(np.array([0.0, tilt, 0.0]))[0]
    pose[2, 3] = distance
    expected = 1000.0 * radius**2 * np.sin(tilt) * np.cos(tilt) / (distance**2 - radius**2 * np.sin(tilt) ** 2)
    u, v = camera.project_circles(np.zeros((1, 2)), np.array([radius]), pose)[0]
    assert u == pytest.approx(expected, rel=1e-12)  # its +x side is turned towards the camera
    assert v == 0.0


@pytest.mark.parametrize(
    ("distortion", "tolerance"),
    [((0.0, 0.0, 0.0, 0.0), 1e-7), ((-1.0, 0.0, -0.004, 0.003), 1e-3)],
    ids=["exact without distortion", "distortion bends a big spot a little"],
)
def test_centres_of_imaged_circles_are_those_of_conics_fitted_to_imaged_points(
    imaged_circles, pose, spot_board, distortion, tolerance
):
    intrinsics = (22683.0, 22700.0, -1.0, 645.0, 470.0, *distortion)
    camera = CameraModel(*intrinsics, (960, 1280))
    transforms = np.array([pose(25.0, 40.0, 70.0, (1.0, 0.5)), pose(10.0, 200.0, 10.0, (-1.0, 0.2))])
    radii = spot_board.diameters() / 2
    centres = camera.project_circles(spot_board.centres(), radii, transforms)
    points = camera.project_circles(spot_board.centres(), 0 * radii, transforms)
    assert np.abs(centres - points).max() > 5 * tolerance  # the eccentricity is seen
    for found, transform in zip(centres, transforms, strict=True):
        assert found == pytest.approx(imaged_circles(spot_board.centres(), radii, transform, intrinsics), abs=tolerance)


def test_a_circle_without_size_is_a_point(pose, spot_board):
    transform = pose(20.0, 40.0, 70.0, (1.0, 0.5))
    xyz = np.column_stack([spot_board.centres(), np.zeros(99)]) @ transform[:3, :3].T + transform[:3, 3]
    assert PAPER.project_circles(spot_board.centres(), np.zeros(99), transform) == pytest.approx(PAPER.project(xyz))
