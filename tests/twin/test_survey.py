"""Claims about where light paths are spent: no light is lost, and no pixel that sees two shapes is missed."""

from dataclasses import dataclass
from functools import partial

import numpy as np
import pytest

import greenough.twin as gt
from greenough.instrument.contract import Placement
from greenough.twin.plugins import fringe
from greenough.twin.plugins.survey import CameraRay, Survey, survey
from greenough.twin.renderer import dr, mi

GLASS = ("twin.optics.glass=true",)
RIM = 8  # pixels: what begins outside of the picture is not seen
MIDDLE = ("camera.rows=96", "camera.cols=128", "twin.optics.camera_focal_px=22683.0")


def everything(scene, size, camera_ray):
    """A survey that leaves nothing out."""
    cols, rows = size
    pixel = dr.arange(mi.UInt32, cols * rows)
    return Survey(pixel, pixel)


@pytest.mark.parametrize("glass", [(), GLASS], ids=["ideal", "glass"])
@pytest.mark.parametrize("part", ["plane", "bga", "coin"])
def test_what_is_left_out_is_dark(small, monkeypatch, part, glass):
    rig, _ = small(*glass, "twin.render.nodes=16", "twin.render.nodes_edges=16", "twin.render.bounces=1")
    rig.operator.place(Placement(part))
    rig.stage.move_to_mm(1.2)
    patterns = gt.rig.fringe_patterns(rig)[:2]
    ours = rig.irradiance(patterns)
    monkeypatch.setattr(fringe, "survey", everything)
    whole, _ = small(*glass, "twin.render.nodes=16", "twin.render.nodes_edges=16", "twin.render.bounces=1")
    whole.operator.place(Placement(part))
    whole.stage.move_to_mm(1.2)
    np.testing.assert_array_equal(ours, whole.irradiance(patterns))
    assert ours.any()


def test_the_dark_part_of_the_field_is_left_out(small):
    rig, bench = small()
    rig.operator.place(Placement("plane"))
    optics, (rows, cols) = bench.settings.optics, rig.projector.shape
    pixel = optics.pupil_distance_mm / optics.camera_focal_px
    lit = rows * optics.row_pitch_um * cols * optics.column_pitch_um * 1e-6 / pixel**2
    assert lit <= dr.width(looked_at(rig).lit) < 1.4 * lit  # a rim of two or three of these coarse pixels


@pytest.mark.parametrize("glass", [(), GLASS], ids=["ideal", "glass"])
@pytest.mark.parametrize("height", [-1.4, 0.0, 1.4])
def test_every_pixel_that_sees_two_shapes_is_found(small, glass, height):
    rig, _ = small(*MIDDLE, *glass)
    rig.operator.place(Placement("board"))
    rig.stage.move_to_mm(height)
    seen = looked_at(rig)
    pixel = dr.arange(mi.UInt32, seen.pixels)
    first, mixed = None, np.zeros(seen.pixels, bool)
    for u in np.random.default_rng(1).random((200, 4)).astype(np.float32):
        si = seen.scene.ray_intersect(seen.ray(pixel, mi.Point2f(*u[:2].tolist()), mi.Point2f(*u[2:].tolist()))[0])
        shape = dr.reinterpret_array(mi.UInt32, si.shape).numpy()
        first = shape if first is None else first
        mixed |= shape != first
    found = np.zeros(seen.pixels, bool)
    found[seen.edges.numpy()] = True
    missed = (mixed & ~found).reshape(seen.shape)[RIM:-RIM, RIM:-RIM]
    assert mixed.any()
    assert not missed.any()
    assert found.mean() < 0.6  # the insides of spots and the ground between them are left


def test_other_lights_reach_everywhere():
    scene = mi.load_dict({"type": "scene", "light": {"type": "constant"}, "ball": {"type": "sphere"}})
    sensor = mi.load_dict({
        "type": "perspective", "fov": 30, "film": {"type": "hdrfilm", "width": 16, "height": 8},
        "to_world": mi.ScalarTransform4f().look_at([0, 0, 5], [0, 0, 0], [0, 1, 0]),
    })  # fmt: skip
    assert dr.width(survey(scene, (16, 8), partial(fringe._camera_ray, sensor)).lit) == 16 * 8


@dataclass(frozen=True, eq=False)
class Looked:
    """What a rig has mounted, as surveyed."""

    scene: mi.Scene
    ray: CameraRay
    shape: tuple[int, int]
    lit: mi.UInt32
    edges: mi.UInt32

    @property
    def pixels(self) -> int:
        return self.shape[0] * self.shape[1]


def looked_at(rig) -> Looked:
    scene = mi.load_dict(rig.scene_dict(gt.rig.fringe_patterns(rig)[:1]))
    sensor = scene.sensors()[0]
    cols, rows = fringe._size(sensor)
    ray = partial(fringe._camera_ray, sensor)
    seen = survey(scene, (cols, rows), ray)
    return Looked(scene, ray, (rows, cols), seen.lit, seen.edges)
