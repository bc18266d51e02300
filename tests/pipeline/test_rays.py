import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from greenough.pipeline.camera_model import CameraModel
from greenough.pipeline.rays import points_at_height, rays_of_camera

SHAPE = (48, 64)


def camera():
    """The paper's Table 2, its picture thinned to a few pixels of 200 µm."""
    return CameraModel(1134.2, 1138.0, -0.3, 31.8, 26.0, -0.09531, 0.02512, -0.00869, -0.00273, SHAPE)


def pose(tilt_deg=6.0):
    """Looking down on the board: +x to the right, +y upwards in the picture, tilted about y."""
    rotation = Rotation.from_euler("y", tilt_deg, degrees=True).as_matrix() @ np.diag([1.0, -1.0, -1.0])
    camera_from_world = np.eye(4)
    camera_from_world[:3, :3] = rotation
    camera_from_world[:3, 3] = [0.3, -0.2, 224.56]
    return camera_from_world


@settings(max_examples=100)
@given(
    x=st.floats(-5, 5), y=st.floats(-4, 4), z=st.floats(-1.5, 1.5), tilt=st.floats(-30, 30), turn=st.floats(-180, 180)
)
def test_a_point_projected_and_raised_to_its_height_comes_back(x, y, z, tilt, turn):
    camera_from_world = pose(tilt)
    camera_from_world[:3, :3] = camera_from_world[:3, :3] @ Rotation.from_euler("z", turn, degrees=True).as_matrix()
    point = np.array([[x, y, z]])
    pixel = camera().project(point @ camera_from_world[:3, :3].T + camera_from_world[:3, 3])
    back = points_at_height(pixel, point[:, 2], camera(), camera_from_world)
    np.testing.assert_allclose(back, point, atol=1e-8)


def test_pixels_at_the_origin_of_the_picture_need_no_special_care():
    # Eq. 23 as printed divides by u and by v.
    xyz = points_at_height(np.array([[0.0, 0.0], [0.0, 5.0], [5.0, 0.0]]), np.zeros(3), camera(), pose())
    assert np.isfinite(xyz).all()


def test_every_pixels_ray_is_the_line_of_its_points():
    rays = rays_of_camera(camera(), pose())
    z = np.random.default_rng(3).uniform(-1.5, 1.5, SHAPE)
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]]
    expected = points_at_height(np.stack([u.ravel(), v.ravel()], axis=-1), z.ravel(), camera(), pose())
    np.testing.assert_allclose(rays.points(z).reshape(-1, 3), expected, atol=2e-6)


def test_places_between_pixels_lie_on_rays_of_their_own():
    rays = rays_of_camera(camera(), pose())
    rng = np.random.default_rng(4)
    pixels, z = rng.uniform([0, 0], [SHAPE[1] - 1, SHAPE[0] - 1], (200, 2)), rng.uniform(-1.5, 1.5, 200)
    expected = points_at_height(pixels, z, camera(), pose())
    np.testing.assert_allclose(rays.points_at(pixels, z), expected, atol=5e-6)


@pytest.mark.parametrize("pixel", [(-0.01, 5.0), (5.0, 47.01), (np.nan, 5.0)])
def test_there_is_no_ray_outside_the_picture(pixel):
    rays = rays_of_camera(camera(), pose())
    points = rays.points_at(np.array([pixel, (5.0, 5.0), (63.0, 47.0)]), np.zeros(3))
    assert np.isnan(points).all(axis=-1).tolist() == [True, False, False]


def test_unknown_heights_give_no_points():
    z = np.zeros(SHAPE)
    z[3, 4] = np.nan
    assert np.isnan(rays_of_camera(camera(), pose()).points(z)).all(axis=-1).sum() == 1
