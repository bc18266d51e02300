"""Claims about the plugins behind glass: a plane seen through both paths, and rays that another tracer follows."""

import numpy as np
import pytest
from numpy.polynomial.hermite_e import hermegauss
from scipy.ndimage import binary_erosion

from greenough.twin.glass.as_built import Tolerances, draw_path_errors
from greenough.twin.glass.glasses import index
from greenough.twin.glass.placed import errors_to_json, place
from greenough.twin.glass.prescription import load_prescription
from greenough.twin.renderer import mi
from greenough.twin.scene import axis_frame

DISTANCE = 224.56
LEAN = np.radians(6)
SHAPE = (240, 320)
FOCAL = 22683.0 / 4  # the whole field in coarse pixels
MIDDLE = (120, 160)
SOME = np.s_[4::9, 4::9]  # pixels whose chief rays are followed
PERIOD = 12
FROM_PATH = np.diag([-1.0, 1.0, -1.0, 1.0])  # path coordinates to those of Mitsuba's sensors
FROM_PATH[2, 3] = DISTANCE
PLANE_Z = 0.8


def errors_of(name):
    lens = load_prescription(name)
    return draw_path_errors(lens, Tolerances(), np.random.default_rng({"camera": 1, "projector": 2}[name]))


def snell(path, point, direction, surfaces, towards_image, wavelength_um):
    """Rays (n, 3) in double precision by centres of curvature and Snell's law in vectors."""
    for k in surfaces:
        surface = path.surfaces[k]
        vertex, axis = np.array(surface.vertex), np.array(surface.axis)
        if surface.curvature == 0:
            point = point + direction * ((vertex - point) @ axis / (direction @ axis))[:, None]
            normal = np.broadcast_to(axis, point.shape)
        else:
            radius = 1 / surface.curvature
            to_centre = vertex + radius * axis - point
            along = np.sum(direction * to_centre, axis=1)
            half_chord = np.sqrt(radius**2 - np.sum(to_centre**2, axis=1) + along**2)
            nearer = -1 if (radius > 0) == towards_image else 1  # the side of the sphere where its vertex lies
            point = point + direction * (along + nearer * half_chord)[:, None]
            normal = (vertex + radius * axis - point) / radius
        before, behind = (index(glass, wavelength_um) for glass in (surface.glass_before, surface.glass_behind))
        ratio = before / behind if towards_image else behind / before
        cosine = np.sum(normal * direction, axis=1)[:, None]
        across = ratio * (direction - cosine * normal)
        direction = across + np.sign(cosine) * np.sqrt(1 - np.sum(across**2, axis=1))[:, None] * normal
    return point, direction


def chief_rays(path, points, towards_image, wavelength_um):
    """Points and directions of the rays from ``points`` (n, 3) through the middle of the stop, behind all lenses."""
    n, stop = len(path.surfaces), path.prescription.stop
    order = list(range(n) if towards_image else reversed(range(n)))
    until_stop = order[: order.index(stop) + 1]
    pupil = np.array([0.0, 0.0, {True: 224.56, False: 797.86}[towards_image]])
    gain = {True: 1.179, False: -6.37}[towards_image]
    target = np.tile(pupil, (len(points), 1))

    def towards_target():
        away = target - points
        away = away * np.sign(away[:, 2:]) * (1 if towards_image else -1)  # the pupil may lie behind
        return away / np.linalg.norm(away, axis=1, keepdims=True)

    for _ in range(12):
        met, _ = snell(path, points, towards_target(), until_stop, towards_image, wavelength_um)
        target[:, :2] -= gain * met[:, :2]
    return snell(path, points, towards_target(), order, towards_image, wavelength_um)


@pytest.fixture(scope="module")
def phases():
    return np.arange(PERIOD) * 2 * np.pi / PERIOD


def scene(aperture, phases, glass=True, **projector):
    """A white plane, both lenses, and one fringe of 12 columns shown with 12 phases."""
    column = np.arange(608) * 2 * np.pi / PERIOD
    patterns = np.round(127.5 * (1 + np.cos(column + phases[:, None])))[:, None, :].repeat(684, axis=1)
    film = {"type": "hdrfilm", "width": SHAPE[1], "height": SHAPE[0], "pixel_format": "luminance"}
    common = {"focus_distance": DISTANCE, "aperture_radius": aperture}

    def lens(name):
        return {"prescription": name, "glass_errors": errors_to_json(errors_of(name))} if glass else {}

    return {
        "type": "scene",
        "integrator": {"type": "fringe", "nodes": 16, "bounces": 1},
        "sensor": {
            "type": "lens_sensor",
            "to_world": mi.ScalarTransform4f(axis_frame(-LEAN, DISTANCE)),
            "focal_length_px": FOCAL,
            "film": film | {"component_format": "float32", "rfilter": {"type": "box"}},
        } | common | lens("camera"),
        "projector": {
            "type": "lens_projector",
            "to_world": mi.ScalarTransform4f(axis_frame(LEAN, DISTANCE)),
            "patterns": mi.TensorXf(patterns.astype(np.float32)),
            "column_pitch": 17.835182e-3, "row_pitch": 8.923021e-3,
            "wavelength": 0.525e-3, "diffraction_na": 0.015,
        } | common | lens("projector") | projector,
        "plane": {
            "type": "rectangle",
            "to_world": mi.ScalarTransform4f().translate([0, 0, PLANE_Z]).scale([9, 9, 1]),
            "bsdf": {"type": "diffuse", "reflectance": 0.8},
        },
    }  # fmt: skip


def decoded(stack, phases):
    """Column modulo the period, (rows, cols)."""
    return np.angle(stack @ np.exp(-1j * phases)) * PERIOD / (2 * np.pi)


def expected_columns(wavelength_um=0.525):
    """Columns on the array that the chief rays of SOME pixels meet by way of the plane."""
    camera, projector = (place(load_prescription(name), errors_of(name)) for name in ("camera", "projector"))
    rows, cols = SHAPE
    u, v = np.meshgrid(np.arange(cols) - (cols - 1) / 2, np.arange(rows) - (rows - 1) / 2)
    u, v = u[SOME], v[SOME]
    pitch = 85.06126429 / FOCAL
    on_sensor = np.stack([-u.ravel() * pitch, v.ravel() * pitch], axis=1)  # the image is upside down
    image = camera.image
    points = np.array(image.centre) + on_sensor @ np.array([image.along_x, image.along_y])
    at, direction = chief_rays(camera, points, False, wavelength_um)
    twin_from_camera, twin_from_projector = (axis_frame(lean, DISTANCE) @ FROM_PATH for lean in (-LEAN, LEAN))
    at = at @ twin_from_camera[:3, :3].T + twin_from_camera[:3, 3]
    direction = direction @ twin_from_camera[:3, :3].T
    seen = at + direction * ((PLANE_Z - at[:, 2]) / direction[:, 2])[:, None]
    local = (seen - twin_from_projector[:3, 3]) @ twin_from_projector[:3, :3]
    at, direction = chief_rays(projector, local, True, wavelength_um)
    image = projector.image
    normal = np.array(image.normal)
    landed = at + direction * ((np.array(image.centre) - at) @ normal / (direction @ normal))[:, None]
    x = (landed - image.centre) @ np.array(image.along_x)
    # The mirrors' rows are staggered by half a column: what two rows show together lies in the array's middle.
    return (303.5 + x / (6.572 / 608)).reshape(u.shape)


def departure(phase_columns, columns):
    """By how much columns known modulo the period depart from ``columns``."""
    return (phase_columns - columns + PERIOD / 2) % PERIOD - PERIOD / 2


@pytest.mark.slow
def test_chief_rays_through_both_paths_carry_the_column_that_another_tracer_finds(phases):
    stack = np.array(mi.render(mi.load_dict(scene(0.0, phases))), float)[SOME]
    columns = expected_columns()
    lit = (columns > 10) & (columns < 598) & (stack.mean(axis=2) > 0.8 * np.median(stack.mean(axis=2)))
    assert lit.sum() > 400
    # A pixel is the mean over its square: the fringe's curvature in it is the rest.
    miss = departure(decoded(stack, phases), columns)[lit]
    assert np.abs(miss).max() < 0.005


def test_without_glass_the_same_scene_misses_by_whole_columns(phases):
    """By the distortion and the assembly's errors."""
    stack = np.array(mi.render(mi.load_dict(scene(0.0, phases, glass=False))), float)[SOME]
    assert np.abs(departure(decoded(stack, phases), expected_columns())[8:-8, 8:-8]).max() > 1


def test_an_open_stop_takes_the_aberrations_centroid_with_it(phases):
    """Coma displaces phase by at most both paths' 1.7 + 1.2 µm (design), of columns 17.8 µm wide."""
    pinhole, lens = (np.array(mi.render(mi.load_dict(scene(a, phases))), float) for a in (0.0, 3.3684))
    lit = np.minimum(pinhole.mean(axis=2), lens.mean(axis=2)) > 0.9 * lens.mean(axis=2)[MIDDLE]
    miss = departure(decoded(lens, phases), decoded(pinhole, phases))
    assert 0.02 < np.abs(miss[lit]).max() < 0.4


def test_a_broad_spectrum_moves_the_phase_by_the_mean_of_lateral_colour(phases):
    """Over a Gaussian of 30 nm full width at half maximum, by Gauss and Hermite's quadrature."""
    narrow, broad = (np.array(mi.render(mi.load_dict(scene(0.0, phases, bandwidth_um=w))), float) for w in (0, 0.03))
    node, weight = hermegauss(7)
    colours = [expected_columns(0.525 + 0.03 / np.sqrt(8 * np.log(2)) * x) for x in node]
    expected = np.tensordot(weight / weight.sum(), colours, axes=1) - expected_columns()
    columns = expected_columns()
    lit = (columns > 10) & (columns < 598) & (narrow[SOME].mean(axis=2) > 0.8 * np.median(narrow[SOME].mean(axis=2)))
    moved = departure(decoded(broad, phases), decoded(narrow, phases))[SOME]
    assert np.abs(expected[lit]).max() > 0.005
    assert np.abs(moved - expected)[lit].max() < 0.1 * np.abs(expected[lit]).max()


def test_light_falls_off_where_rims_cut_it(phases):
    """The projector passes 93 % of the stop in its corners by design; away from them nothing is cut."""
    flat = mi.TensorXf(np.full((1, 684, 608), 255, np.float32))
    glass, ideal = (
        np.array(mi.render(mi.load_dict(scene(3.3684, phases, glass=g, patterns=flat))), float)[..., 0]
        for g in (True, False)
    )
    lit = binary_erosion((glass > 0.9 * glass[MIDDLE]) & (ideal > 0.9 * ideal[MIDDLE]), iterations=4)
    ratio = glass[lit] / ideal[lit]
    assert np.median(ratio) == pytest.approx(1, abs=0.005)
    assert 0.9 < ratio.min() < 0.98
    assert ratio.max() < 1.005
