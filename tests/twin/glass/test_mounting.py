"""Claims about glass in the place of an ideal lens. Chief rays are found by a tracer of this module's own."""

import numpy as np
import pytest

from greenough.instrument.errors import InputError
from greenough.twin.glass.as_built import Tolerances, draw_path_errors
from greenough.twin.glass.glasses import index
from greenough.twin.glass.mounting import mount
from greenough.twin.glass.placed import errors_from_json, errors_to_json, place
from greenough.twin.glass.prescription import load_prescription
from greenough.twin.renderer import dr, mi

PUPIL_Z = 224.56
PLANE = np.array([0.05, -0.03, 1.0]), 0.4  # normal and offset of a plane in path coordinates


def reference_trace(path, point, direction, wavelength_um, surfaces):
    """One ray in double precision by centres of curvature and Snell's law in vectors; to the last of ``surfaces``."""
    direction = direction / np.linalg.norm(direction)
    for k in surfaces:
        surface = path.surfaces[k]
        vertex, axis = np.array(surface.vertex), np.array(surface.axis)
        if surface.curvature == 0:
            point = point + direction * (axis @ (vertex - point)) / (axis @ direction)
            normal = axis
        else:
            radius = 1 / surface.curvature
            centre = vertex + radius * axis
            along = direction @ (centre - point)
            half_chord = np.sqrt(radius**2 - np.sum((centre - point) ** 2) + along**2)
            hits = [point + direction * t for t in (along - half_chord, along + half_chord)]
            point = min(hits, key=lambda hit: abs(axis @ (hit - vertex)))
            normal = (centre - point) / radius
        forwards = np.sign(normal @ direction)
        before, behind = (index(glass, wavelength_um) for glass in (surface.glass_before, surface.glass_behind))
        ratio = before / behind if forwards > 0 else behind / before
        across = ratio * (direction - (normal @ direction) * normal)
        direction = across + forwards * np.sqrt(1 - across @ across) * normal
    return point, direction


def chief_image(path, point, wavelength_um):
    """Where on the image the ray from ``point`` through the middle of the stop lands, mm from the centre, (2,)."""
    target = np.array([0.0, 0.0, PUPIL_Z])
    for _ in range(12):
        met, _ = reference_trace(path, point, target - point, wavelength_um, range(path.prescription.stop + 1))
        target[:2] -= 1.18 * met[:2]  # the pupil is that much larger than the stop
    at, direction = reference_trace(path, point, target - point, wavelength_um, range(len(path.surfaces)))
    centre, u, v = (np.array(a) for a in (path.image.centre, path.image.along_x, path.image.along_y))
    normal = np.cross(u, v)
    landed = at + direction * (normal @ (centre - at)) / (normal @ direction) - centre
    return np.array([landed @ u, landed @ v])


def sloppy(name, seed=5):
    prescription = load_prescription(name)
    tolerances = Tolerances(decentre_mm=0.06, tilt_deg=0.1, image_tilt_deg=0.6)
    return draw_path_errors(prescription, tolerances, np.random.default_rng(seed))


def local(path_points):
    """Path coordinates (n, 3) in the frame of Mitsuba's sensors."""
    return path_points * [-1, 1, -1] + [0, 0, PUPIL_Z]


# A chief ray by polynomials may miss the stop's middle by micrometres away from the design wavelength, which moves what
# it meets out of focus.
@pytest.mark.parametrize(("wavelength_um", "tolerance_nm"), [(0.525, 30), (0.540, 80)])
def test_pixels_see_where_the_chief_ray_comes_from(wavelength_um, tolerance_nm):
    errors = sloppy("camera")
    camera = mount("camera", errors_to_json(errors), outwards=False, nodes=16)
    x, y = (a.ravel() for a in np.meshgrid(np.linspace(-6.3, 6.3, 4), np.linspace(-4.7, 4.7, 4)))
    middle = mi.Point2f(0, 0)
    origin, direction, weight = camera.ray(mi.Float(x), mi.Float(y), middle, wavelength_um)
    o, d = np.array(origin, float).T, np.array(direction, float).T
    path_o, path_d = (o - [0, 0, PUPIL_Z]) * [-1, 1, -1], d * [-1, 1, -1]
    normal, offset = PLANE
    t = (offset - path_o @ normal) / (path_d @ normal)
    seen = path_o + t[:, None] * path_d
    path = place(load_prescription("camera"), errors)
    expected = np.array([x, -y]).T * -0.3787908081
    landed = np.array([chief_image(path, point, wavelength_um) for point in seen])
    assert np.abs(landed - expected).max() / 0.379 * 1e6 < tolerance_nm
    assert np.array(weight) == pytest.approx(1, abs=0.01)


@pytest.mark.parametrize(("wavelength_um", "tolerance_nm"), [(0.525, 30), (0.540, 80)])
def test_points_are_lit_by_the_mirror_that_the_chief_ray_meets(wavelength_um, tolerance_nm):
    errors = sloppy("projector")
    projector = mount("projector", errors_to_json(errors), outwards=True, nodes=16)
    rng = np.random.default_rng(1)
    points = rng.uniform([-5.4, -3.0, -1.5], [5.4, 3.0, 1.5], (16, 3))
    pupil, x, y, weight = projector.look_up(mi.Point3f(local(points).T), mi.Point2f(0, 0), wavelength_um)
    path = place(load_prescription("projector"), errors)
    expected = np.array([chief_image(path, point, wavelength_um) for point in points])
    ours = np.array([np.array(x, float), -np.array(y, float)]).T * 0.6060611352
    assert np.abs(ours - expected).max() / 0.606 * 1e6 < tolerance_nm
    assert np.array(weight) == pytest.approx((PUPIL_Z / (PUPIL_Z - points[:, 2])) ** 2, abs=0.01)
    assert np.array(pupil, float)[2] == pytest.approx(np.zeros(16), abs=0)
    assert np.abs(np.array(pupil, float)[:2]).max() < 0.2  # the pupil's middle but for decentred lenses


def test_light_outside_of_the_field_finds_no_way_to_the_mirrors():
    """Rays are not tested against the stop: far from the field the polynomials must not let anything through."""
    projector = mount("projector", "", outwards=True, nodes=16)
    rng = np.random.default_rng(2)
    n = 20_000
    radius, angle = rng.uniform(7, 60, n), rng.uniform(0, 2 * np.pi, n)
    points = np.stack([radius * np.cos(angle), radius * np.sin(angle), rng.uniform(-3, 3, n)], axis=1)
    disk = mi.warp.square_to_uniform_disk_concentric(mi.Point2f(rng.uniform(size=(2, n)).astype(np.float32)))
    _, x, y, weight = projector.look_up(mi.Point3f(local(points).T), disk, 0.525)
    on_the_array = (np.abs(np.array(x)) < 5.42) & (np.abs(np.array(y)) < 3.05)
    assert not (on_the_array & (np.array(weight) > 0)).any()


def test_designed_glass_shows_what_the_ideal_lens_does_but_for_its_distortion():
    camera = mount("camera", "", outwards=False, nodes=16)
    origin, direction, _ = camera.ray(mi.Float([0.0, 1.0, 5.0]), mi.Float([0.0, -1.0, 0.0]), mi.Point2f(0, 0), 0.525)
    t = (PUPIL_Z - origin.z) / direction.z
    at = np.array(origin + t * direction, float)
    # The ideal lens sees columns along -x and rows along -y.
    assert at[0] == pytest.approx([0, -1.0, -5.0], rel=2e-3, abs=1e-5)
    assert at[1] == pytest.approx([0, 1.0, 0], rel=2e-3, abs=1e-5)


def test_pencils_cut_by_a_rim_fade_without_steps():
    """The mean over 16 rays falls smoothly along the diagonal, and as the rims' true share within 3 %."""
    camera = mount("camera", "", outwards=False, nodes=16)
    side = (np.arange(4) + 0.5) / 4
    square = mi.Point2f(np.array([a.ravel() for a in np.meshgrid(side, side)], np.float32))
    disk = np.array(mi.warp.square_to_uniform_disk_concentric(square))
    field = np.linspace(0, 1.0, 201)
    x, y = (np.repeat(half * field, 16) for half in (6.336, 4.752))
    many = mi.Point2f(np.tile(disk, 201))
    _, _, weight = camera.ray(mi.Float(x), mi.Float(y), many, 0.525)
    light = np.array(weight).reshape(201, 16).mean(axis=1)
    assert np.abs(np.diff(light)).max() < 0.008  # one ray after the other would make steps of 0.06
    assert light[-1] / light[0] == pytest.approx(0.9217, abs=0.03)  # the design's share in the corner
    assert light[100] == pytest.approx(light[0], abs=0.01)


def test_errors_survive_being_written_as_text():
    prescription = load_prescription("projector")
    errors = sloppy("projector")
    assert errors_from_json(errors_to_json(errors), prescription) == errors


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('{"decentres": {"ocular": [0, 0]}}', "no element 'ocular'; it has 'objective'"),
        ('{"tilt": {}}', "tilt"),
        ('{"image_tilt": [1]}', "image_tilt"),
    ],
)
def test_errors_of_no_such_path_are_refused(text, said):
    with pytest.raises(InputError, match=said):
        errors_from_json(text, load_prescription("camera"))


def test_gradients_flow_through_glass():
    """For calibration by rendering: the image point's derivative is the magnification."""
    projector = mount("projector", "", outwards=True, nodes=16)
    x = mi.Float(0.0)
    dr.enable_grad(x)
    _, column, _, _ = projector.look_up(mi.Point3f(-x, 0, PUPIL_Z), mi.Point2f(0, 0), 0.525)
    dr.forward(x)
    assert dr.grad(column)[0] == pytest.approx(1.0, abs=1e-4)
