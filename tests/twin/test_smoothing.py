"""Claims about averaging along surfaces, but not across their edges."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from greenough.twin.plugins.smoothing import smoothed
from greenough.twin.renderer import dr, mi

COLS, ROWS = 60, 40
RADIUS = 4
PITCH = 0.01


def floor(x: float, z: float, reflectance: float, tilt_deg: float = 0.0) -> dict[str, object]:
    """A square of 0.6 whose left side is at x, above all else where it is higher."""
    pose = mi.ScalarTransform4f().translate([x, 0, z]).rotate([0, 1, 0], tilt_deg).scale(0.3).translate([1, 0, 0])
    return {"type": "rectangle", "to_world": pose, "bsdf": {"type": "diffuse", "reflectance": reflectance}}


def seen(scene: mi.Scene) -> mi.SurfaceInteraction3f:
    """What pixels ``PITCH`` apart see from above, the middle one at the origin."""
    pixel = dr.arange(mi.UInt32, ROWS * COLS)
    x = (mi.Float(pixel % COLS) - COLS / 2 + 0.5) * PITCH
    y = (mi.Float(pixel // COLS) - ROWS / 2 + 0.5) * PITCH
    si = scene.ray_intersect(mi.Ray3f(mi.Point3f(x, y, 5), mi.Vector3f(0, 0, -1)))
    dr.eval(si)
    return si


def scene_of(**bodies: dict[str, object]) -> mi.Scene:
    return mi.load_dict({"type": "scene"} | bodies)


def after(scene: mi.Scene, *pictures: np.ndarray) -> list[np.ndarray]:
    channels = [mi.Float(picture.ravel().astype(np.float32)) for picture in pictures]
    return [np.array(channel).reshape(ROWS, COLS) for channel in smoothed(channels, seen(scene), (COLS, ROWS), RADIUS)]


def test_noise_on_a_plane_is_averaged_in_every_channel():
    rng = np.random.default_rng(1)
    noise = rng.normal(size=(3, ROWS, COLS))
    weights = np.exp(-0.5 * (1.5 * np.arange(-RADIUS, RADIUS + 1) / RADIUS) ** 2)
    weights /= weights.sum()
    for tilt in (0.0, 40.0):
        scene = scene_of(plane=floor(-0.31, 0.0 if tilt == 0 else 0.3, 0.5, tilt), under=floor(-0.31, -5.0, 0.2))
        middle = np.s_[RADIUS:-RADIUS, RADIUS : COLS // 2]
        for before, smooth in zip(noise, after(scene, *noise), strict=True):
            expected = before
            for axis in (0, 1):
                expected = np.apply_along_axis(np.convolve, axis, expected, weights, mode="same")
            assert_allclose(smooth[middle], expected[middle], atol=1e-4)


def test_what_is_even_stays():
    ball = {"type": "sphere", "radius": 0.2, "center": [0, 0, 0.1]}
    (smooth,) = after(scene_of(ball=ball, plane=floor(-0.3, 0.0, 0.5)), np.full((ROWS, COLS), 0.7))
    assert_allclose(smooth, 0.7, rtol=1e-5)


@pytest.mark.parametrize(
    "other",
    [floor(0.0, 0.001, 0.2), floor(0.0, 0.1, 0.5), floor(0.0, 0.0, 0.5, -40.0)],
    ids=["another material", "a step", "a bend"],
)
def test_edges_stay_sharp(other):
    scene = scene_of(left=floor(-0.6, 0.0, 0.5), right=other)
    picture = np.zeros((ROWS, COLS))
    picture[:, COLS // 2 :] = 1.0
    (smooth,) = after(scene, picture)
    assert_allclose(smooth, picture, atol=0.02)


def test_what_sees_nothing_stays_as_it_is():
    picture = np.random.default_rng(2).normal(size=(ROWS, COLS))
    scene = scene_of(plane=floor(0.0, 0.0, 0.5))
    (smooth,) = after(scene, picture)
    missed = ~np.array(seen(scene).is_valid()).reshape(ROWS, COLS)
    assert missed.sum() >= ROWS * COLS // 2
    assert_array_equal(smooth[missed], picture.astype(np.float32)[missed])
    assert (smooth[~missed] != picture.astype(np.float32)[~missed]).any()
