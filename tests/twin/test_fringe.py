"""Claims about the one-pass integrator. Comparisons by chance refuse equal pictures once in a thousand times."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from greenough.twin.quadrature import nodes
from greenough.twin.renderer import mi

FALSE_ALARM = 1e-3
DIFFUSE = {"type": "diffuse", "reflectance": 0.8}
CONDUCTOR = {"type": "roughconductor", "material": "none", "distribution": "ggx", "alpha": 0.25}
PLASTIC = {"type": "roughplastic", "distribution": "ggx", "alpha": 0.3, "diffuse_reflectance": 0.4}


@pytest.mark.slow
@pytest.mark.parametrize("bsdf", [CONDUCTOR, PLASTIC], ids=["conductor", "plastic"])
@pytest.mark.essential
def test_direct_light_on_glossy_surfaces_is_mitsubas(scenery, chance, bsdf):
    bodies = {name: body | {"bsdf": bsdf} for name, body in scenery.bodies().items()}
    ours = scenery.renders(scenery.perspective(), scenery.lens_projector(), scenery.fringe(), bodies)
    theirs = scenery.renders(
        scenery.perspective(), scenery.projector(0), scenery.path(), bodies, seeds=range(1000, 1032)
    )
    assert chance(ours[..., :1], theirs, scenery.paths) > FALSE_ALARM


@pytest.mark.slow
@pytest.mark.parametrize("bsdf", [DIFFUSE, CONDUCTOR, PLASTIC], ids=["diffuse", "conductor", "plastic"])
def test_interreflection_in_a_corner_is_mitsubas(scenery, chance, chance_brightness, bsdf):
    corner = scenery.corner(bsdf)
    theirs = scenery.renders(
        scenery.perspective(), scenery.projector(0), scenery.path(2), corner, seeds=range(1000, 1032)
    )
    ours = scenery.renders(scenery.perspective(), scenery.lens_projector(), scenery.fringe(2), corner)[..., :1]
    assert chance(ours, theirs, scenery.paths) > FALSE_ALARM
    assert chance_brightness(ours, theirs) > FALSE_ALARM
    direct = scenery.renders(scenery.perspective(), scenery.lens_projector(), scenery.fringe(1), corner)[..., :1]
    assert chance(direct, theirs, scenery.paths) < FALSE_ALARM
    # Over the whole picture a tenth of the second bounce's light would be seen.
    assert chance_brightness(0.9 * ours + 0.1 * direct, theirs) < FALSE_ALARM


@pytest.mark.slow
def test_further_bounces_are_mitsubas(scenery, chance):
    corner = scenery.corner(DIFFUSE)
    theirs = scenery.renders(
        scenery.perspective(), scenery.projector(0), scenery.path(4), corner, seeds=range(1000, 1032)
    )
    for bounces, alike in ((4, True), (2, False)):
        ours = scenery.renders(scenery.perspective(), scenery.lens_projector(), scenery.fringe(bounces), corner)
        assert (chance(ours[..., :1], theirs, scenery.paths) > FALSE_ALARM) == alike


@pytest.mark.slow
def test_a_plane_cannot_light_itself(scenery):
    bodies = {"plane": scenery.bodies()["plane"]}
    one, two = (
        scenery.renders(scenery.lens_sensor(), scenery.lens_projector(), scenery.fringe(bounces), bodies, seeds=[3])
        for bounces in (1, 2)
    )
    assert one.max() > 0.1
    assert_allclose(two, one, atol=1e-6)


@pytest.mark.slow
def test_one_pass_gives_each_pattern_what_it_gets_alone(scenery):
    patterns = np.random.default_rng(4).integers(0, 256, (7, *scenery.mirrors), dtype=np.uint8)
    fixed = scenery.fringe(2, shift_per_pixel=False)
    corner = scenery.corner(DIFFUSE)

    def shown(stack: np.ndarray) -> np.ndarray:
        emitter = scenery.lens_projector(patterns=mi.TensorXf(stack.astype(np.float32)))
        return scenery.renders(scenery.lens_sensor(), emitter, fixed, corner, seeds=[0])[0]

    together = shown(patterns)
    assert together.shape == (*scenery.shape, 7)
    for k in (0, 3, 6):
        assert_allclose(together[..., k], shown(patterns[k : k + 1])[..., 0], rtol=1e-5, atol=1e-7)


def test_the_fixed_nodes_know_no_seed_and_the_shifted_ones_do(scenery):
    fixed = scenery.renders(
        scenery.lens_sensor(), scenery.lens_projector(), scenery.fringe(shift_per_pixel=False), seeds=[0, 1]
    )
    assert_array_equal(fixed[0], fixed[1])
    shifted = scenery.renders(scenery.lens_sensor(), scenery.lens_projector(), scenery.fringe(), seeds=[0, 1, 0])
    assert (shifted[0] != shifted[1]).any()
    assert_array_equal(shifted[0], shifted[2])


@pytest.mark.slow
def test_samples_per_pixel_override_the_nodes(scenery):
    parts = {"type": "scene", "sensor": scenery.lens_sensor(), "emitter": scenery.lens_projector()} | scenery.bodies()
    few, many = (
        mi.load_dict(parts | {"integrator": scenery.fringe(2, shift_per_pixel=False, nodes=nodes)})
        for nodes in (16, 256)
    )
    assert_array_equal(np.array(mi.render(few, spp=256)), np.array(mi.render(many)))
    assert (np.array(mi.render(few)) != np.array(mi.render(many))).any()


def test_nodes_can_be_given_one_by_one(scenery):
    parts = {"type": "scene", "sensor": scenery.lens_sensor(), "emitter": scenery.lens_projector()} | scenery.bodies()
    fixed = scenery.fringe(shift_per_pixel=False, nodes=16)
    own, table = (mi.load_dict(parts | {"integrator": fixed | more}) for more in ({}, {"node_table": table_of(16)}))
    assert_array_equal(np.array(mi.render(own)), np.array(mi.render(table)))
    middle = mi.load_dict(parts | {"integrator": fixed | {"node_table": mi.TensorXf(np.full((1, 6), 0.5))}})
    assert (np.array(mi.render(middle)) != np.array(mi.render(own))).any()
    assert_array_equal(np.array(mi.render(middle, spp=16)), np.array(mi.render(own)))


def table_of(count: int) -> mi.TensorXf:
    return mi.TensorXf(nodes(count, 6))


def test_more_nodes_come_nearer_to_the_mean_of_shifted_ones(scenery):
    mean = scenery.renders(scenery.lens_sensor(), scenery.lens_projector(), scenery.fringe()).mean(axis=0)
    parts = {"type": "scene", "sensor": scenery.lens_sensor(), "emitter": scenery.lens_projector()} | scenery.bodies()
    fixed = mi.load_dict(parts | {"integrator": scenery.fringe(shift_per_pixel=False)})
    errors = [np.sqrt(np.mean((np.array(mi.render(fixed, spp=spp)) - mean) ** 2)) for spp in (4, 64, 1024)]
    assert errors[1] < errors[0] / 3
    assert errors[2] < errors[1] / 3


@pytest.mark.slow
def test_light_of_other_emitters_is_the_same_in_all_channels(scenery, chance):
    lamp = {"type": "point", "position": [2.0, 1.0, 6.0], "intensity": 5.0}
    bodies = scenery.bodies() | {"lamp": lamp}
    ours = scenery.renders(scenery.lens_sensor(), scenery.lens_projector(), scenery.fringe(), bodies)
    without = scenery.renders(scenery.lens_sensor(), scenery.lens_projector(), scenery.fringe())
    glow = ours - without  # the same paths, so that the lamp alone is left
    assert_allclose(glow[..., 0], glow[..., 1], atol=1e-5)
    theirs = scenery.renders(scenery.perspective(), scenery.projector(1), scenery.path(), bodies)
    assert chance(ours[..., 1:], theirs, scenery.paths) > FALSE_ALARM


@pytest.mark.slow
def test_a_lamp_in_the_picture_is_seen(scenery, chance):
    above = mi.ScalarTransform4f().translate([0.5, 0, 2.0]).scale([0.5, 0.3, 1])
    lamp = {"type": "rectangle", "to_world": above, "emitter": {"type": "area", "radiance": 1.5}}
    bodies = scenery.bodies() | {"lamp": lamp}
    ours = scenery.renders(scenery.lens_sensor(), scenery.lens_projector(), scenery.fringe(), bodies)
    theirs = scenery.renders(
        scenery.perspective(), scenery.projector(0), scenery.path(), bodies, seeds=range(1000, 1032)
    )
    assert ours.max() > 1.4
    assert chance(ours[..., :1], theirs, scenery.paths) > FALSE_ALARM


def test_two_projectors_add_their_light(scenery):
    fixed = scenery.fringe(shift_per_pixel=False)
    first = scenery.lens_projector()
    second = scenery.lens_projector(patterns=mi.TensorXf(scenery.patterns[::-1].astype(np.float32)), irradiance=0.5)
    one, other, both = (
        scenery.renders(scenery.lens_sensor(), emitter, fixed, scenery.bodies() | more, seeds=[0])
        for emitter, more in ((first, {}), (second, {}), (first, {"second": second}))
    )
    assert_allclose(both, one + other, atol=1e-6)


def test_without_a_projector_there_is_one_channel(scenery):
    lamp = {"type": "point", "position": [2.0, 1.0, 6.0], "intensity": 5.0}
    picture = scenery.renders(scenery.lens_sensor(), lamp, scenery.fringe(), seeds=[0])
    assert picture.shape == (1, *scenery.shape, 1)
    assert picture.max() > 0


def test_a_shadow_is_black_and_the_background_too(scenery):
    wall = mi.ScalarTransform4f().translate([1.2, 0, 5.0]).scale([0.5, 5, 1]).rotate([0, 1, 0], 180)
    bodies = scenery.bodies() | {"wall": {"type": "rectangle", "to_world": wall}}
    white = mi.TensorXf(np.full((1, *scenery.mirrors), 255, np.float32))
    emitter = scenery.lens_projector(patterns=white)
    lit = scenery.renders(scenery.lens_sensor(), emitter, scenery.fringe(2), seeds=[0])[0, ..., 0]
    shaded = scenery.renders(scenery.lens_sensor(), emitter, scenery.fringe(1), bodies, seeds=[0])[0, ..., 0]
    darkened = (shaded == 0) & (lit > 0.05)
    assert darkened.sum() > 50


def test_it_says_what_it_is(scenery):
    assert "FringeIntegrator" in str(mi.load_dict(scenery.fringe()))


@pytest.mark.parametrize(("relief", "shades"), [(False, False), (True, True)])
def test_only_relief_stands_in_its_own_light(relief, shades):
    """The same scene with shadow rays and without: alike on a plane, darker with them beside a ball."""
    looks = mi.ScalarTransform4f().look_at
    scene = {
        "type": "scene",
        "sensor": {
            "type": "lens_sensor", "focal_length_px": 200, "focus_distance": 10, "aperture_radius": 0.1,
            "to_world": looks(origin=[0, 0, 10], target=[0, 0, 0], up=[0, 1, 0]),
            "film": {"type": "hdrfilm", "width": 32, "height": 24, "pixel_format": "luminance"},
        },
        "projector": {
            "type": "lens_projector", "patterns": mi.TensorXf(np.full((1, 64, 64), 255, np.float32)),
            "column_pitch": 0.1, "row_pitch": 0.1, "focus_distance": 10, "aperture_radius": 0.1,
            "to_world": looks(origin=[6, 0, 10], target=[0, 0, 0], up=[0, 1, 0]),
        },
        "floor": {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(5)},
    }  # fmt: skip
    if relief:
        scene["ball"] = {"type": "sphere", "center": [0, 0, 0.3], "radius": 0.3}
    with_them, without = (
        np.array(mi.render(mi.load_dict(scene | {"integrator": {"type": "fringe", "bounces": 1, "shadows": shadows}})))
        for shadows in (True, False)
    )
    assert without.max() > 0
    assert (with_them.min() < 0.5 * without.min()) == shades
    if not shades:
        np.testing.assert_allclose(with_them, without, rtol=1e-6)
