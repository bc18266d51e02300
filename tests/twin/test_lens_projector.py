"""Claims about the projector behind a lens. Comparisons by chance refuse equal pictures once in a thousand times."""

from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from greenough.twin.dmd import Mirrors, band_limited
from greenough.twin.renderer import mi
from greenough.twin.scene import axis_frame

FALSE_ALARM = 1e-3
NA, WAVELENGTH, DISTANCE = 0.015, 0.525e-3, 224.56
PITCH = (17.835e-3, 8.923e-3)


def projector(patterns: np.ndarray, **changes: Any) -> Any:
    """The default projector path of the twin, at the origin and shining along +z."""
    properties = {
        "type": "lens_projector",
        "patterns": mi.TensorXf(patterns.astype(np.float32)),
        "column_pitch": PITCH[0],
        "row_pitch": PITCH[1],
        "focus_distance": DISTANCE,
    }
    return mi.load_dict(properties | changes)


def white(rows: int = 20, cols: int = 30) -> np.ndarray:
    return np.full((1, rows, cols), 255, np.uint8)


def pupil_samples(n: int = 2000) -> mi.Point2f:
    return mi.Point2f(*np.random.default_rng(3).random((2, n)).astype(np.float32))


def test_a_pinhole_with_square_pixels_is_mitsubas_projector(scenery, native, chance):
    ours = scenery.renders(scenery.perspective(), scenery.lens_projector(), scenery.fringe())
    assert chance(ours, native, scenery.paths) > FALSE_ALARM


@pytest.mark.parametrize("pattern", [0, 1])
def test_it_is_also_under_mitsubas_own_integrator_one_pattern_at_a_time(scenery, native, chance, pattern):
    ours = scenery.renders(scenery.perspective(), scenery.lens_projector(pattern=pattern), scenery.path())
    assert chance(ours, native[..., pattern : pattern + 1], scenery.paths) > FALSE_ALARM
    assert chance(ours, native[..., 1 - pattern : 2 - pattern], scenery.paths) < FALSE_ALARM


@pytest.mark.parametrize("changes", [{"irradiance": 1.01}, {"column_pitch": 0.404}, {"focus_distance": 10.1}])
def test_a_projector_that_is_a_hundredth_off_is_told_apart(scenery, native, chance, changes):
    ours = scenery.renders(scenery.perspective(), scenery.lens_projector(**changes), scenery.fringe())
    assert chance(ours, native, scenery.paths) < FALSE_ALARM


def test_a_pattern_shifted_by_half_a_pixel_is_told_apart(scenery, native, chance):
    doubled = np.repeat(scenery.patterns, 2, axis=2)  # pixels of half the width
    same, shifted = doubled, np.roll(doubled, 1, axis=2)
    for patterns, alike in ((same, True), (shifted, False)):
        emitter = scenery.lens_projector(patterns=mi.TensorXf(patterns.astype(np.float32)), column_pitch=0.2)
        ours = scenery.renders(scenery.perspective(), emitter, scenery.fringe())
        assert (chance(ours, native, scenery.paths) > FALSE_ALARM) == alike


@pytest.mark.slow
def test_a_lens_gives_the_same_picture_under_mitsubas_integrator(scenery, chance):
    lens = {"aperture_radius": 0.6, "focus_distance": 9.0}
    one_pass = scenery.renders(scenery.perspective(), scenery.lens_projector(**lens), scenery.fringe())
    for pattern in (0, 1):
        emitter = scenery.lens_projector(pattern=pattern, **lens)
        alone = scenery.renders(scenery.perspective(), emitter, scenery.path(), seeds=range(1000, 1032))
        assert chance(one_pass[..., pattern : pattern + 1], alone, scenery.paths) > FALSE_ALARM
    sharper = scenery.renders(
        scenery.perspective(), scenery.lens_projector(**lens | {"aperture_radius": 0.4}), scenery.fringe()
    )
    assert chance(sharper[..., 1:], alone, scenery.paths) < FALSE_ALARM


@pytest.mark.slow
def test_band_limited_mirrors_give_the_same_picture_under_mitsubas_integrator(scenery, chance):
    # An Airy disc about as large as a mirror, so that the mirrors' lattice is seen as well.
    lens = {"aperture_radius": 0.3, "wavelength": 0.02, "off_state": 0.05}
    one_pass = scenery.renders(scenery.perspective(), scenery.lens_projector(**lens), scenery.fringe())
    emitter = scenery.lens_projector(pattern=1, **lens)
    alone = scenery.renders(scenery.perspective(), emitter, scenery.path(), seeds=range(1000, 1032))
    assert chance(one_pass[..., 1:], alone, scenery.paths) > FALSE_ALARM


def test_a_white_lambertian_plane_in_focus_reflects_the_stated_irradiance_over_pi():
    scene = {
        "type": "scene",
        "integrator": {"type": "fringe", "bounces": 1},
        "sensor": {
            "type": "perspective",
            "to_world": mi.ScalarTransform4f(axis_frame(-0.3, 50.0)),
            "fov": 1.0,
            "film": {"type": "hdrfilm", "width": 8, "height": 6, "pixel_format": "luminance"},
        },
        "emitter": {
            "type": "lens_projector",
            "to_world": mi.ScalarTransform4f(axis_frame(0.0, DISTANCE)),
            "patterns": mi.TensorXf(white(200, 200).astype(np.float32)),
            "column_pitch": 0.1,
            "row_pitch": 0.1,
            "focus_distance": DISTANCE,
            "aperture_radius": 5.0,
            "irradiance": 2.0,
        },
    }
    for height in (0.0, 20.0):
        plane = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, height]).scale(30)}
        lit = mi.load_dict(scene | {"plane": plane | {"bsdf": {"type": "diffuse", "reflectance": 1.0}}})
        # Nearer to the lens the same light falls on less: by the square of the distance along the axis.
        expected = 2.0 / np.pi * (DISTANCE / (DISTANCE - height)) ** 2
        assert_allclose(np.array(mi.render(lit)), expected, rtol=1e-5)


@pytest.mark.parametrize("aperture", [0.0, NA * DISTANCE])
def test_columns_and_rows_are_those_of_the_central_projection_onto_the_focused_plane(aperture):
    emitter = projector(white(20, 30), aperture_radius=aperture)
    samples = pupil_samples()
    for column, row in ((0, 0), (7, 3), (29, 19)):
        # Columns run along -x, rows along -y; the middle of 30 columns is at 14.5, that of 20 rows at 9.5.
        p = mi.Point3f((14.5 - column) * PITCH[0], (9.5 - row) * PITCH[1], DISTANCE)
        pupil, at_column, at_row, _ = emitter.aim(p, samples)
        # In focus every point of the pupil sees the same mirror; float32 leaves some 1e-5 mm in the focused plane.
        assert_allclose(np.array(at_column), column, atol=3e-3)
        assert_allclose(np.array(at_row), row, atol=5e-3)
        assert np.hypot(*np.array(pupil)[:2]).max() <= aperture * (1 + 1e-6)


@pytest.mark.parametrize("defocus", [-1.5, 1.5])
def test_a_point_out_of_focus_sees_a_uniform_disc_of_mirrors(defocus):
    emitter = projector(white(), aperture_radius=NA * DISTANCE)
    _, column, row, _ = emitter.aim(mi.Point3f(0, 0, DISTANCE + defocus), pupil_samples(20_000))
    radius = NA * DISTANCE * abs(defocus) / (DISTANCE + defocus)
    x, y = (np.array(column) - 14.5) * PITCH[0] / radius, (np.array(row) - 9.5) * PITCH[1] / radius
    square = x**2 + y**2
    assert square.max() <= 1 + 1e-3
    # The square of the radius is uniform from 0 to 1, the angle all round; five standard errors of 20000 samples.
    assert np.mean(square) == pytest.approx(0.5, abs=5 * 0.29 / np.sqrt(20_000))
    assert np.mean(x) == pytest.approx(0, abs=5 * 0.5 / np.sqrt(20_000))
    assert np.mean(x * x) == pytest.approx(0.25, abs=5 * 0.26 / np.sqrt(20_000))


def test_behind_the_lens_there_is_no_light():
    _, _, _, light = projector(white()).aim(mi.Point3f(0, 0, -DISTANCE), mi.Point2f(0.5))
    assert light[0] == 0


def test_the_middle_of_a_diamond_array_is_a_quarter_column_further_on():
    on_axis = mi.Point3f(0, 0, DISTANCE)
    _, column, row, _ = projector(white(20, 30), diffraction_na=NA, wavelength=WAVELENGTH).aim(on_axis, mi.Point2f(0.5))
    assert column[0] == pytest.approx(14.75)
    assert row[0] == pytest.approx(9.5)


@pytest.mark.parametrize("n", [1, 2, 5, 8])
@pytest.mark.parametrize("along_rows", [True, False])
def test_light_is_read_from_the_table_of_the_diffracted_patterns(n, along_rows):
    patterns = np.random.default_rng(n).integers(0, 256, (n, 20, 30), dtype=np.uint8)
    if not along_rows:
        patterns = np.repeat(patterns[:, :1], 20, axis=1)
    emitter = projector(patterns, diffraction_na=NA, wavelength=WAVELENGTH)
    table = band_limited(patterns, Mirrors(*PITCH, fill=0.92, off_state=0.0), NA, WAVELENGTH)
    # At the cells' centres, where nothing is interpolated between columns.
    j = np.random.default_rng(9).integers(0, table.values.shape[1] - 1, 50)
    column = table.origin[0] + j / table.cells[0]
    if along_rows:
        i = np.random.default_rng(8).integers(0, table.values.shape[0] - 1, 50)
        expected = table.values[i, j]
    else:
        i = np.random.default_rng(8).integers(0, len(table.row_profile) - 1, 50)
        expected = table.values[0, j] * table.row_profile[i][:, None]
    row = table.origin[1] + i / table.cells[1]
    read = emitter.light(mi.Float(column.astype(np.float32)), mi.Float(row.astype(np.float32)), mi.Bool(True))
    assert len(read) == n
    assert_allclose(np.stack([np.array(value) for value in read], axis=-1), expected, atol=1e-6)


def test_between_cells_light_is_interpolated_linearly():
    patterns = np.repeat(np.arange(0, 240, 8, dtype=np.uint8)[None, None], 20, axis=1)
    emitter = projector(patterns, diffraction_na=NA, wavelength=WAVELENGTH)
    row = mi.Float(9.5)
    ends = [emitter.light(mi.Float(column), row, mi.Bool(True))[0][0] for column in (10.0, 10.25)]
    between = emitter.light(mi.Float(10.1), row, mi.Bool(True))[0][0]
    assert between == pytest.approx(0.6 * ends[0] + 0.4 * ends[1], rel=1e-5)


def test_square_pixels_end_at_their_borders_and_so_does_the_array():
    patterns = np.zeros((1, 20, 30), np.uint8)
    patterns[0, 0, 0] = patterns[0, 19, 29] = 255
    emitter = projector(patterns)
    column = mi.Float([-0.6, -0.4, 0.4, 0.6, 28.4, 28.6, 29.4, 29.6])
    row = mi.Float([0.0, -0.4, 0.4, 0.0, 19.0, 18.6, 19.4, 19.0])
    assert_allclose(np.array(emitter.light(column, row, mi.Bool(True))[0]), [0, 1, 1, 0, 0, 1, 1, 0])


def test_other_patterns_can_be_shown():
    emitter = projector(white())
    emitter.set_patterns(np.full((3, 20, 30), 51, np.uint8))
    read = emitter.light(mi.Float(3.0), mi.Float(4.0), mi.Bool(True))
    assert [value[0] for value in read] == pytest.approx([0.2] * 3)


def test_it_says_what_it_is_and_takes_no_space():
    assert "LensProjector" in str(projector(white()))
    assert not projector(white()).bbox().valid()
