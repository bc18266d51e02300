"""Claims about the scene that is rendered. Comparisons by chance refuse equal pictures once in a thousand times."""

from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
import trimesh
from numpy.testing import assert_allclose

import greenough.twin as gt
from greenough.instrument.contract import Placement
from greenough.scenes.materials import MATERIALS
from greenough.scenes.parts import Part
from greenough.twin.diffraction import geometric_transfer, optical_transfer
from greenough.twin.renderer import mi
from greenough.twin.rig import fringe_patterns
from greenough.twin.scene import axis_frame, specimen_dict
from greenough.twin.settings import RenderSettings

FALSE_ALARM = 1e-3
CONVERGENCE = np.radians(12.0)
MIDDLE = ("camera.rows=30", "camera.cols=40")  # half of the field in the same coarse pixels
PATHS = 64


def stack_of(picture: object) -> np.ndarray:
    """(rows, cols, N) as mi.render gives it, as the rig's (N, rows, cols)."""
    return np.moveaxis(np.array(picture), -1, 0)


def renders(scene: mi.Scene, seeds: Sequence[int] = range(20)) -> np.ndarray:
    """Independent stacks, (seeds, N, rows, cols)."""
    return np.stack([stack_of(mi.render(scene, spp=PATHS, seed=mi.UInt32(seed))) for seed in seeds]).astype(float)


@pytest.mark.slow
@pytest.mark.parametrize(
    "sample", ["plane", "coin", "bga", "diaphragm-concave", "second-board", Placement("board", posture=3)], ids=str
)
@pytest.mark.essential
def test_the_scene_rendered_by_mitsuba_is_the_rigs_irradiance(small, sample):
    rig, _ = small()
    rig.stage.move_to_mm(0.3)
    patterns = fringe_patterns(rig)[:5]
    scene = mi.load_dict(gt.scene_dict(rig, sample, patterns))
    irradiance = rig.irradiance(patterns)
    assert irradiance.max() > 0.1
    # The same nodes and paths; kernels may add in another order.
    assert_allclose(stack_of(mi.render(scene)), irradiance, rtol=1e-5, atol=1e-7)


def test_the_scenes_default_patterns_are_the_fringes_of_the_rigs_procedure(small):
    rig, _ = small()
    picture = mi.render(mi.load_dict(gt.scene_dict(rig, "plane")))
    assert_allclose(stack_of(picture), rig.irradiance(fringe_patterns(rig)), rtol=1e-5, atol=1e-7)


@pytest.mark.slow
def test_independent_renders_of_the_scene_are_the_rigs_irradiance_but_for_chance(small, chance):
    # A smooth specimen and so many nodes that the fixed ones are as good as exact.
    exact = ("twin.render.nodes=2048", "twin.render.nodes_indirect=512", "twin.optics.camera_diffraction=false")
    rig, _ = small(*MIDDLE, *exact)
    patterns = fringe_patterns(rig)[[0, 12]]
    parts = gt.scene_dict(rig, "diaphragm-raised", patterns)
    scene = mi.load_dict(parts | {"integrator": parts["integrator"] | {"shift_per_pixel": True}})
    shifted = renders(scene)
    irradiance = rig.irradiance(patterns).astype(float)
    assert chance(shifted, np.broadcast_to(irradiance, shifted.shape), PATHS) > FALSE_ALARM
    # The same test sees a hundredth of brightness, and half a pixel.
    half = (irradiance + np.roll(irradiance, 1, axis=2)) / 2
    for wrong in (1.01 * irradiance, half):
        assert chance(shifted, np.broadcast_to(wrong, shifted.shape), PATHS) < FALSE_ALARM


@pytest.mark.slow
def test_anybodys_integrator_sees_one_pattern_of_the_scene(small, chance):
    # Square pixels: what the Airy pattern does to an edge, the two integrators sample differently.
    rig, _ = small(*MIDDLE, "twin.optics.camera_diffraction=false")
    patterns = fringe_patterns(rig)[[12]]
    parts = gt.scene_dict(rig, "bga", patterns)
    native = renders(mi.load_dict(parts | {"integrator": {"type": "path", "max_depth": 3}}), range(1000, 1020))
    for bounces, alike in ((2, True), (1, False)):
        changes = {"shift_per_pixel": True, "bounces": bounces, "nodes_indirect": 64, "smoothing": 0}
        shifted = renders(mi.load_dict(parts | {"integrator": parts["integrator"] | changes}))
        assert (chance(shifted, native, PATHS) > FALSE_ALARM) == alike


@pytest.mark.parametrize("height", [-1.45, -0.75, 0.0, 0.75, 1.45])
def test_fringes_on_a_plane_have_the_contrast_that_mirrors_lenses_and_pixels_leave(small, height):
    full = ("camera.rows=24", "camera.cols=64", "twin.optics.camera_focal_px=22683")
    rig, bench = small(*full, perfect=True)
    rig.operator.place(Placement("plane"))
    rig.stage.move_to_mm(height)
    lines = rig.irradiance(fringe_patterns(rig)[-12:]).astype(float)
    phasor = (lines * np.exp(-2j * np.pi * np.arange(12) / 12)[:, None, None]).sum(axis=0)
    contrast = 2 * np.abs(phasor) / lines.sum(axis=0)

    na, wavelength, pitch, pixel = 0.015, 0.525e-3, 17.835e-3, 224.56 / 22683
    along = np.gradient(bench.truth().column, axis=1).mean()  # columns per pixel
    # The fringe's frequency in either focused plane.
    projected, seen = np.array(1 / (12 * pitch)), np.array(along / (12 * pixel))
    grey = np.rint(np.round(127.5 * (1 + np.cos(2 * np.pi * np.arange(12) / 12)), 9)) / 255
    sent = 2 * np.abs((grey * np.exp(-2j * np.pi * np.arange(12) / 12)).mean()) * (1 - 0.001)
    sent /= 0.001 + (1 - 0.001) * grey.mean()
    diagonal = np.sqrt(0.92) * pitch
    mirrors = np.sinc(projected * diagonal / 2) ** 2 * np.cos(np.pi / 24)
    defocus = height * np.cos(CONVERGENCE / 2)
    projector = optical_transfer(projected, na, wavelength) * geometric_transfer(projected, na, defocus)
    camera = optical_transfer(seen, na, wavelength) * geometric_transfer(seen, na, defocus) * np.sinc(seen * pixel)
    assert_allclose(contrast, sent * mirrors * projector * camera, rtol=0.01)


def test_both_axes_meet_at_the_origin_and_lean_in_the_x_z_plane():
    for angle in (-0.1, 0.2):
        frame = axis_frame(angle, 224.56)
        assert_allclose(frame @ [0, 0, 224.56, 1], [0, 0, 0, 1], atol=1e-12)
        assert_allclose(frame[:3, :3].T @ frame[:3, :3], np.eye(3), atol=1e-15)
        assert np.linalg.det(frame[:3, :3]) == pytest.approx(1)
        assert_allclose(frame[:3, 3], 224.56 * np.array([np.sin(angle), 0, np.cos(angle)]))
        assert_allclose(frame[:3, 1], [0, 1, 0])  # y up, against the rows


def test_a_white_plane_reflects_its_share_of_the_light(small):
    rig, _ = small(perfect=True)
    rig.operator.place(Placement("plane"))
    white = np.full((1, *rig.projector.shape), 255, np.uint8)
    middle = rig.irradiance(white)[0, 28:32, 38:42]
    # Ceramic of 0.85, met at half of the convergence; the Airy pattern's tails cross 300 mirrors to the edge.
    assert_allclose(middle, 0.85 * np.cos(CONVERGENCE / 2) / np.pi, rtol=3e-3)


def test_spots_and_ink_differ_in_brightness_as_their_materials_do(small):
    rig, bench = small(
        "camera.rows=40", "camera.cols=40", "twin.optics.camera_focal_px=22683", perfect=True, pinholes=True
    )
    rig.operator.place(Placement("board"))
    picture = rig.irradiance(np.full((1, *rig.projector.shape), 255, np.uint8))[0]
    # Where the pixel's whole surroundings are of one material: well inside or outside the spot.
    spots = bench.specimen.as_built["centres_mm"][:, :2]
    xy = bench.truth().xyz_world[..., :2]
    nominal = rig.board.diameters() / 2
    inside = (np.linalg.norm(xy[:, :, None] - spots, axis=-1) - nominal).min(axis=-1)
    assert (inside < -0.02).sum() > 50
    assert (inside > 0.02).sum() > 50
    assert picture[inside < -0.02].mean() / picture[inside > 0.02].mean() == pytest.approx(0.85 / 0.08, rel=0.01)


@pytest.mark.parametrize("name", MATERIALS)
def test_materials_reach_the_renderer_with_their_parameters(name):
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    part = Part(corners, np.array([[0, 1, 2]], np.int32), None, name)
    bsdf = specimen_dict([part], RenderSettings())["part_0"].bsdf()
    parameters = {key: value for key, value in mi.traverse(bsdf)}
    stated = {field.name: getattr(MATERIALS[name], field.name) for field in fields(MATERIALS[name])}
    reflectance = next(value for key, value in parameters.items() if key.endswith("reflectance.value"))
    assert reflectance[0] == pytest.approx(stated["reflectance"])
    if "alpha" in stated:
        assert next(np.ravel(value)[0] for key, value in parameters.items() if "alpha" in key) == pytest.approx(
            stated["alpha"]
        )
        assert "distribution = ggx" in str(bsdf).lower()
    if "ior" in stated:  # against air, 1.00028
        assert np.ravel(parameters["eta"])[0] == pytest.approx(stated["ior"], rel=1e-3)


@pytest.mark.slow
def test_diffuse_only_makes_every_material_lambertian(small):
    rig, _ = small("twin.render.diffuse_only=true")
    scene = mi.load_dict(gt.scene_dict(rig, "bga"))
    assert {shape.bsdf().class_name() for shape in scene.shapes()} == {"SmoothDiffuse"}
    rig, _ = small()
    scene = mi.load_dict(gt.scene_dict(rig, "bga"))
    assert "SmoothDiffuse" not in {shape.bsdf().class_name() for shape in scene.shapes()}


def test_a_mesh_file_is_a_sample(small, tmp_path: Path):
    block = trimesh.creation.box((4.0, 3.0, 0.2))
    block.export(tmp_path / "block.ply")
    rig, bench = small(perfect=True)
    white = np.full((1, *rig.projector.shape), 255, np.uint8)
    scene = mi.load_dict(gt.scene_dict(rig, str(tmp_path / "block.ply"), white))
    assert_allclose(stack_of(mi.render(scene)), rig.irradiance(white), rtol=1e-5, atol=1e-7)
    assert_allclose(bench.truth().xyz[30, 40, 2], 0.1, atol=1e-6)
