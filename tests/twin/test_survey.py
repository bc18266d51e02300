"""Claims about where light paths are spent: no light of shapes that some pixel's middle meets is lost."""

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


def everything(scene, size, camera_ray, wavelength_um, find_edges):
    """A survey that leaves nothing out."""
    return Survey(dr.arange(mi.UInt32, size[0] * size[1]), mi.UInt32())


def loses_nothing(monkeypatch, load) -> None:
    """Compare a picture with that of a survey that leaves nothing out."""
    ours = np.array(mi.render(load()))
    with monkeypatch.context() as patched:
        patched.setattr(fringe, "survey", everything)
        np.testing.assert_array_equal(ours, np.array(mi.render(load())))
    assert ours.any()


@pytest.mark.slow
@pytest.mark.parametrize("glass", [(), GLASS], ids=["ideal", "glass"])
@pytest.mark.parametrize("part", ["bga", "coin"])
def test_what_is_left_out_is_dark(small, monkeypatch, part, glass):
    rig, _ = small(*glass, "twin.render.nodes=16", "twin.render.bounces=1")
    rig.stage.move_to_mm(1.2)
    dictionary = gt.scene_dict(rig, part, gt.rig.fringe_patterns(rig)[:2])
    loses_nothing(monkeypatch, lambda: mi.load_dict(dictionary))


def test_pixels_at_the_rim_of_the_light_are_not_lost(small, monkeypatch):
    """Far out of focus, in the camera's own pixels."""
    rig, _ = small(*MIDDLE, "twin.optics.camera_diffraction=false")
    rig.stage.move_to_mm(1.4)
    dictionary = gt.scene_dict(rig, Placement("plane", pose_mm_deg=(0, 0, 0, 0, 20, 0)), white(rig))
    # The projected field is 6.1 mm high: its upper rim is some 308 pixels above the middle.
    film = dictionary["sensor"]["film"] | {"width": 1280, "height": 960, "crop_width": 96, "crop_height": 64}
    dictionary["sensor"] |= {"film": film | {"crop_offset_x": 592, "crop_offset_y": 140}}
    dictionary["integrator"] = {"type": "fringe", "bounces": 1, "nodes": 64}
    picture = np.array(mi.render(mi.load_dict(dictionary)))[..., 0]
    assert (picture == 0).any()
    assert ((picture > 0) & (picture < picture.max() / 2)).any()
    loses_nothing(monkeypatch, lambda: mi.load_dict(dictionary))


GROUND = {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale([6, 6, 1]), "bsdf": {"type": "diffuse"}}
RAISED = GROUND | {"to_world": mi.ScalarTransform4f().translate([0, 0, 3]).scale([6, 6, 1])}
BALL = {"type": "sphere", "radius": 0.35, "center": [0.3, 0.2, 3.0], "bsdf": {"type": "diffuse"}}  # out of focus
LAMP = {"type": "point", "position": [2.0, 1.0, 6.0], "intensity": 5.0}


@pytest.mark.parametrize(
    "bodies",
    [{"ball": BALL}, {"ball": BALL, "ground": GROUND}, {"ball": BALL, "lamp": LAMP}, {"ground": RAISED}],
    ids=["ball", "ball on ground", "another light", "ground out of focus"],
)
@pytest.mark.parametrize("crop", [{}, {"crop_offset_x": 27, "crop_width": 8, "crop_offset_y": 8, "crop_height": 12}])
@pytest.mark.parametrize("lens", ["perspective", "lens_sensor"])
def test_no_light_is_lost_in_scenes_of_others(scenery, monkeypatch, bodies, crop, lens):
    film = scenery.film | crop
    wide = {} if lens == "perspective" else {"aperture_radius": 0.8}
    parts = {
        "type": "scene",
        "sensor": getattr(scenery, lens)(film=film, **wide),
        "one": scenery.lens_projector(aperture_radius=2.0, column_pitch=0.1, row_pitch=0.1),
        "two": scenery.lens_projector(to_world=scenery.camera_pose, column_pitch=0.05, row_pitch=0.05),
        "integrator": scenery.fringe(nodes=64),
    }
    loses_nothing(monkeypatch, lambda: mi.load_dict(parts | bodies))


@pytest.mark.parametrize("shape", [(1, 1), (20, 1), (1, 20)])
def test_pictures_of_one_row_or_column_are_rendered(scenery, shape):
    rows, cols = shape
    sensor = scenery.lens_sensor(film=scenery.film | {"width": cols, "height": rows}, aperture_radius=0.1)
    parts = {"type": "scene", "sensor": sensor, "one": scenery.lens_projector(), "integrator": scenery.fringe()}
    assert np.array(mi.render(mi.load_dict(parts | {"ground": GROUND})))[..., 0].shape == shape


def test_without_emitters_all_is_dark(scenery):
    parts = {"type": "scene", "sensor": scenery.lens_sensor(), "integrator": scenery.fringe(), "ground": GROUND}
    assert not np.array(mi.render(mi.load_dict(parts))).any()


def white(rig) -> np.ndarray:
    return np.full((1, *rig.projector.shape), 255, np.uint8)


def test_the_dark_part_of_the_field_is_left_out(small):
    rig, bench = small()
    rig.operator.place(Placement("plane"))
    optics, (rows, cols) = bench.settings.optics, rig.projector.shape
    pixel = optics.pupil_distance_mm / optics.camera_focal_px
    lit = rows * optics.row_pitch_um * cols * optics.column_pitch_um * 1e-6 / pixel**2
    found = looked_at(rig)
    frame = 2 * sum(found.shape) * 2  # two pixels wide
    # Around the light a rim of two or three of these coarse pixels is left in.
    assert lit <= dr.width(found.lit) + dr.width(found.edges) - frame < 1.5 * lit


@pytest.mark.slow
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
    assert dr.width(survey(scene, (16, 8), partial(fringe._camera_ray, sensor), 0.525, find_edges=False).lit) == 16 * 8


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
    seen = survey(scene, (cols, rows), ray, 0.525, find_edges=True)
    return Looked(scene, ray, (rows, cols), seen.lit, seen.edges)
