"""Claims about the camera behind a lens. Comparisons by chance refuse equal pictures once in a thousand times."""

from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from greenough.twin.diffraction import optical_transfer, pixel_response
from greenough.twin.renderer import dr, mi

FALSE_ALARM = 1e-3
NA, WAVELENGTH, DISTANCE, FOCAL_PX = 0.015, 0.525e-3, 224.56, 22683.0


def sensor(shape: tuple[int, int] = (9, 12), **changes: Any) -> Any:
    """The default camera path of the twin, at the origin and looking along +z."""
    film = {"type": "hdrfilm", "width": shape[1], "height": shape[0], "pixel_format": "luminance"}
    properties = {"type": "lens_sensor", "focal_length_px": FOCAL_PX, "focus_distance": DISTANCE, "film": film}
    return mi.load_dict(properties | changes)


def film_positions(n: int = 1000) -> tuple[mi.Point2f, mi.Point2f]:
    rng = np.random.default_rng(5)
    return mi.Point2f(*rng.random((2, n)).astype(np.float32)), mi.Point2f(*rng.random((2, n)).astype(np.float32))


def test_a_pinhole_without_diffraction_is_mitsubas_perspective_camera(scenery, native, chance):
    ours = scenery.renders(scenery.lens_sensor(), scenery.lens_projector(), scenery.fringe())
    assert chance(ours, native, scenery.paths) > FALSE_ALARM


def test_it_is_also_under_mitsubas_own_integrator(scenery, native, chance):
    ours = scenery.renders(scenery.lens_sensor(), scenery.projector(0), scenery.path())
    assert chance(ours, native[..., :1], scenery.paths) > FALSE_ALARM


@pytest.mark.parametrize(
    "changes",
    [
        {"principal_point_px": mi.ScalarPoint2f(20.0, 14.5)},
        {"principal_point_px": mi.ScalarPoint2f(19.5, 14.8)},
        {"focal_length_px": 60.6},
    ],
)
def test_a_camera_that_is_half_a_pixel_or_a_hundredth_off_is_told_apart(scenery, native, chance, changes):
    ours = scenery.renders(scenery.lens_sensor(**changes), scenery.lens_projector(), scenery.fringe())
    assert chance(ours, native, scenery.paths) < FALSE_ALARM


@pytest.mark.slow
@pytest.mark.parametrize("integrator", ["fringe", "path"])
def test_a_lens_without_diffraction_is_mitsubas_thin_lens(scenery, chance, integrator):
    lens = {"aperture_radius": 0.6, "focus_distance": 9.0}
    theirs = scenery.renders(
        scenery.perspective(type="thinlens", **lens), scenery.projector(0), scenery.path(), seeds=range(1000, 1032)
    )
    method = scenery.fringe() if integrator == "fringe" else scenery.path()
    # The image's scale belongs to the pinhole equivalent: it does not change with the focus.
    ours = scenery.renders(scenery.lens_sensor(**lens), scenery.projector(0), method)
    assert chance(ours, theirs, scenery.paths) > FALSE_ALARM
    for wrong in ({"aperture_radius": 0.7}, {"focus_distance": 9.5}, {"aperture_radius": 0.0}):
        other = scenery.renders(scenery.lens_sensor(**lens | wrong), scenery.projector(0), method)
        assert chance(other, theirs, scenery.paths) < FALSE_ALARM


def test_rays_of_all_pupil_points_meet_in_the_focused_plane():
    camera = sensor(aperture_radius=NA * DISTANCE)
    _, pupil = film_positions()
    ray, weight = camera.sample_ray(0.0, 0.5, mi.Point2f(0.3, 0.6), pupil)
    focused = np.array(ray((DISTANCE - ray.o.z) / ray.d.z))
    assert_allclose(focused - focused.mean(axis=1, keepdims=True), 0, atol=5e-5)  # float32 at 224 mm
    radius = np.hypot(*np.array(ray.o)[:2])
    assert radius.max() <= NA * DISTANCE * (1 + 1e-6)
    # A uniform disc: the square of the radius is uniform.
    assert np.mean((radius / (NA * DISTANCE)) ** 2) == pytest.approx(0.5, abs=0.05)
    assert (np.array(weight) == 1).all()


def test_columns_run_along_minus_x_and_rows_along_minus_y_from_the_principal_point():
    camera = sensor(principal_point_px=mi.ScalarPoint2f(3.0, 2.0))
    for column, row in ((3, 2), (0, 0), (11, 8)):
        ray, _ = camera.sample_ray(0.0, 0.5, mi.Point2f((column + 0.5) / 12, (row + 0.5) / 9), mi.Point2f(0.5))
        slope = np.array(ray.d).ravel()
        assert_allclose(-slope[0] / slope[2], (column - 3) / FOCAL_PX, atol=1e-7)
        assert_allclose(-slope[1] / slope[2], (row - 2) / FOCAL_PX, atol=1e-7)


def test_a_crop_of_the_film_is_a_part_of_the_picture(scenery):
    fixed = scenery.fringe(shift_per_pixel=False)
    for camera in (scenery.lens_sensor, scenery.perspective):
        whole = scenery.renders(camera(), scenery.lens_projector(), fixed, seeds=[0])[0]
        window = {"crop_width": 11, "crop_height": 7, "crop_offset_x": 13, "crop_offset_y": 9}
        part = scenery.renders(camera(film=scenery.film | window), scenery.lens_projector(), fixed, seeds=[0])[0]
        assert part.shape == (7, 11, 2)
        # Rounding moves a few paths over an edge of the pattern; another offset would have nothing in common.
        assert np.median(np.abs(part - whole[9:16, 13:24])) < 1e-6
        assert np.abs(part - whole[9:16, 13:24]).mean() < 1e-3 * whole.max()


def test_a_crop_is_seen_alike_by_mitsubas_integrator(scenery, native, chance):
    window = {"crop_width": 11, "crop_height": 7, "crop_offset_x": 13, "crop_offset_y": 9}
    camera = scenery.lens_sensor(film=scenery.film | window)
    ours = scenery.renders(camera, scenery.projector(0), scenery.path())
    assert chance(ours, native[:, 9:16, 13:24, :1], scenery.paths) > FALSE_ALARM


def test_ray_differentials_are_the_rays_of_the_neighbours():
    camera = sensor(aperture_radius=NA * DISTANCE)
    position, pupil = mi.Point2f(0.4, 0.7), mi.Point2f(0.2, 0.9)
    ray, _ = camera.sample_ray_differential(0.0, 0.5, position, pupil)
    right, _ = camera.sample_ray(0.0, 0.5, mi.Point2f(0.4 + 1 / 12, 0.7), pupil)
    below, _ = camera.sample_ray(0.0, 0.5, mi.Point2f(0.4, 0.7 + 1 / 9), pupil)
    assert ray.has_differentials
    for ours, theirs in ((ray.d_x, right.d), (ray.d_y, below.d), (ray.o_x, right.o), (ray.o_y, below.o)):
        assert_allclose(np.array(ours), np.array(theirs), atol=1e-7)


def test_samples_of_a_pixel_follow_the_tables_of_its_response():
    camera = sensor(wavelength=WAVELENGTH, diffraction_na=NA)
    marginal, conditional = pixel_response(DISTANCE / FOCAL_PX, NA, WAVELENGTH)
    u, v = np.random.default_rng(2).random((2, 5000)).astype(np.float32)
    x, y = camera.displacement(mi.Float(u), mi.Float(v))
    assert_allclose(np.array(x), np.interp(u, np.linspace(0, 1, len(marginal)), marginal), atol=1e-3)
    rows = np.stack([np.interp(v, np.linspace(0, 1, conditional.shape[1]), row) for row in conditional])
    at = u.astype(float) * (len(rows) - 1)
    low, sample = at.astype(int), np.arange(len(u))
    expected = rows[low, sample] * (1 - at + low) + rows[low + 1, sample] * (at - low)
    # Where the tails are steep, the last digit of a float32 sample is a visible step.
    assert np.median(np.abs(np.array(y) - expected)) < 1e-5
    assert_allclose(np.array(y), expected, atol=0.02)


def test_without_diffraction_a_pixel_is_a_square():
    u, v = film_positions()[0]
    x, y = sensor().displacement(u, v)
    assert_array_equal(np.array(x), np.array(u - 0.5))
    assert_array_equal(np.array(y), np.array(v - 0.5))


def glowing_half_plane(edge_px: float, integrator: dict[str, Any]) -> Any:
    """A scene of 4 x 33 pixels that glows in the columns below 16 + edge_px."""
    pixel = DISTANCE / FOCAL_PX
    half = 500 * pixel
    # x is to the left in the picture.
    facing = mi.ScalarTransform4f().translate([half - edge_px * pixel, 0, DISTANCE]).rotate([0, 1, 0], 180)
    film = {"type": "hdrfilm", "width": 33, "height": 4, "pixel_format": "luminance", "rfilter": {"type": "box"}}
    camera = {"type": "lens_sensor", "focal_length_px": FOCAL_PX, "focus_distance": DISTANCE, "film": film}
    glow = {
        "type": "rectangle",
        "to_world": facing.scale([half, half, 1]),
        "emitter": {"type": "area", "radiance": 1.0},
        "bsdf": {"type": "diffuse", "reflectance": 0.0},
    }
    diffraction = {"wavelength": WAVELENGTH, "diffraction_na": NA}
    return mi.load_dict({"type": "scene", "integrator": integrator, "sensor": camera | diffraction, "glow": glow})


def edge_response(inside_px: np.ndarray) -> np.ndarray:
    """Light of a pixel so far inside an edge: 1/2 + integral of T(f) sin(2 pi f x) / (pi f) df."""
    pixel = DISTANCE / FOCAL_PX
    f = (np.arange(20000) + 0.5) / 20000 * 2 * NA / WAVELENGTH
    transfer = optical_transfer(f, NA, WAVELENGTH) * np.sinc(f * pixel)
    waves = np.sin(2 * np.pi * f * pixel * inside_px[:, None]) / (np.pi * f) * transfer
    return 0.5 + waves.sum(axis=1) * (f[1] - f[0])


@pytest.mark.slow
@pytest.mark.parametrize("edge_px", [0.0, 0.25, 0.7])
@pytest.mark.essential
def test_an_edge_in_focus_is_blurred_by_pixel_and_airy_pattern(edge_px):
    expected = edge_response(16 + edge_px - np.arange(33))
    sampled = mi.render(glowing_half_plane(edge_px, {"type": "path", "max_depth": 2}), spp=1 << 15)
    # The mean of four rows: 0.5 / sqrt(4 * 32768) = 0.0014 at most, and 0.003 of the response's tables.
    assert_allclose(np.array(sampled)[..., 0].mean(axis=0), expected, atol=0.008)
    filtered = mi.render(glowing_half_plane(edge_px, {"type": "fringe", "nodes": 4096, "bounces": 1}))
    # What the tent lets through beyond the pixels' frequencies, worked out in one dimension: at most 0.0082.
    assert_allclose(np.array(filtered)[..., 0].mean(axis=0), expected, atol=0.009)


def test_a_smooth_picture_is_diffracted_as_pixel_and_airy_pattern_would():
    """Cosines under the tent, as ``pixel_ray`` samples them, against box and pupil."""
    camera = sensor((64, 96), wavelength=WAVELENGTH, diffraction_na=NA)
    pixel = DISTANCE / FOCAL_PX
    row, column = np.mgrid[:64, :96]
    for fy, fx in ((0, 8 / 96), (10 / 64, 0), (9 / 64, 12 / 96), (0, 40 / 96)):  # cycles per pixel
        # Half a pixel of phase: such a wave goes on as its own mirror image.
        wave = np.cos(2 * np.pi * fx * (column + 0.5)) * np.cos(2 * np.pi * fy * (row + 0.5))
        box = np.sinc(fx) * np.sinc(fy)
        lens = optical_transfer(np.array(np.hypot(fx, fy) / pixel), NA, WAVELENGTH)
        seen = camera.diffract((wave * box**2).astype(np.float32))
        assert_allclose(seen, wave * box * lens, atol=1e-5)


@pytest.mark.parametrize("diffraction", [{}, {"wavelength": WAVELENGTH, "diffraction_na": NA}], ids=["box", "tent"])
def test_a_pixels_rays_are_spread_over_a_box_or_a_tent(diffraction):
    camera = sensor(principal_point_px=mi.ScalarPoint2f(3.0, 2.0), **diffraction)
    u = (np.arange(20_000) + 0.5) / 20_000
    ray, _ = camera.pixel_ray(mi.Float(3.0), mi.Float(2.0), mi.Point2f(u.astype(np.float32), 0.5), mi.Point2f(0.5))
    x = -np.array(ray.d.x / ray.d.z) * FOCAL_PX
    for cycles in (0.1, 0.5, 0.9):
        transfer = np.cos(2 * np.pi * cycles * x).mean()
        assert transfer == pytest.approx(np.sinc(cycles) ** (2 if diffraction else 1), abs=1e-4)


def test_a_pinhole_can_diffract_like_the_lens_it_stands_for():
    lens = sensor(aperture_radius=NA * DISTANCE, wavelength=WAVELENGTH)
    pinhole = sensor(diffraction_na=NA, wavelength=WAVELENGTH)
    u, v = film_positions()[0]
    for ours, theirs in zip(pinhole.displacement(u, v), lens.displacement(u, v), strict=True):
        assert_array_equal(np.array(ours), np.array(theirs))
    ray, _ = pinhole.sample_ray(0.0, 0.5, film_positions()[0], film_positions()[1])
    assert dr.all(ray.o == 0, axis=None)


def test_it_says_what_it_is():
    assert "LensSensor" in str(sensor())
    assert sensor().bbox().contains(mi.ScalarPoint3f(0, 0, 0))
