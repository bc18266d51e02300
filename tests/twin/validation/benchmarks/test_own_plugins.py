"""Claims about the peer: Mitsuba's own plugins are given the very light that our projector shows."""

import numpy as np
import pytest

import greenough.twin as gt
from greenough.twin.plugins.lens_projector import LensProjector
from greenough.twin.renderer import mi
from greenough.twin.scene import projector_dict
from greenough.twin.validation.benchmarks.own_plugins import PINHOLES, own_plugins, projector_pictures, texel_mm

MIDDLE = ("camera.rows=24", "camera.cols=32", "twin.optics.camera_focal_px=22683.0")
PATHS = 64
SEEDS = 8


def test_a_picture_is_what_our_projector_shows_there(small):
    rig, bench = small(*PINHOLES)
    patterns = gt.rig.fringe_patterns(rig)[[3, -1]]
    optics = bench.settings.optics
    pictures = projector_pictures(patterns, optics)
    emitter = mi.load_dict(projector_dict(bench.settings, patterns))
    assert isinstance(emitter, LensProjector)
    _, rows, cols = patterns.shape
    # At texels: our rows lie between those of the table, where its profile is a straight line but at the rim.
    picked = [np.random.default_rng(1).integers(0, n, 2000) for n in pictures.shape[1:]]
    texel = texel_mm(optics)
    y, x = (p - (n - 1) / 2 for p, n in zip(picked, pictures.shape[1:], strict=True))
    column = (cols - 1) / 2 + 0.25 + x * texel / (optics.column_pitch_um * 1e-3)
    row = (rows - 1) / 2 + y * texel / (optics.row_pitch_um * 1e-3)
    light = emitter.light(mi.Float(column), mi.Float(row), mi.Bool([True] * len(x)))
    assert pictures.max() > 0.9
    for picture, ours in zip(pictures, light, strict=True):
        np.testing.assert_allclose(picture[picked[0], picked[1]], ours.numpy(), atol=2e-4)


@pytest.mark.slow
@pytest.mark.parametrize(("texels", "same"), [(0, True), (1, False)])
def test_both_render_the_same_light_and_a_quarter_of_a_column_shows(small, chance, texels, same):
    """Equal renderers are refused once in a thousand times."""
    rig, bench = small(*MIDDLE, *PINHOLES)
    patterns = gt.rig.fringe_patterns(rig)[[-3, -1]]
    scene = gt.scene_dict(rig, "plane", patterns)
    own = own_plugins(scene, bench.settings, patterns)
    moved = tuple(mi.TensorXf(np.roll(np.array(picture), texels, axis=1)) for picture in own.pictures)
    own = type(own)(own.scene, moved)
    theirs = np.stack([
        np.concatenate([np.array(frame) for frame in own.render(PATHS, range(2), seed)], axis=-1)
        for seed in range(SEEDS)
    ])  # fmt: skip
    ours = mi.load_dict(scene | {"integrator": {"type": "fringe", "bounces": 1, "shift_per_pixel": True}})
    pictures = np.stack([np.array(mi.render(ours, spp=PATHS, seed=mi.UInt32(seed))) for seed in range(SEEDS)])
    assert theirs.shape == pictures.shape
    assert (chance(pictures.astype(float), theirs.astype(float), PATHS) > 1e-3) == same


def test_frames_of_one_seed_have_their_noise_in_common(small):
    rig, bench = small(*MIDDLE, *PINHOLES)
    patterns = gt.rig.fringe_patterns(rig)[[-1, -1]]
    own = own_plugins(gt.scene_dict(rig, "plane", patterns), bench.settings, patterns)
    first, second = own.render(4, range(2), seed=1)
    (other,) = own.render(4, [0], seed=2)
    np.testing.assert_array_equal(np.array(first), np.array(second))
    assert (np.array(first) != np.array(other)).any()
