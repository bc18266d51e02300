"""Claims about instruments as they were assembled."""

import numpy as np
import pytest

from greenough.twin.glass.aberrations import astigmatic_foci, chief_rays, image_points
from greenough.twin.glass.as_built import Tolerances, assemble, draw_path_errors
from greenough.twin.glass.paraxial import paraxial
from greenough.twin.glass.placed import PathErrors, place
from greenough.twin.glass.prescription import load_prescription
from greenough.twin.scene import axis_frame

NONE = Tolerances(decentre_mm=0, tilt_deg=0, image_tilt_deg=0, focus_mm=0, axis_deg=0, pointing_mm=0)
LEAN = np.radians(-6)


def seen_in_the_middle(built) -> np.ndarray:
    """Where in the twin's plane z = 0 the middle of the image sees, (2,)."""
    ray = chief_rays(built.path, np.zeros((1, 2)))
    origin = built.twin_from_path @ [*ray.at_zero[0, 0], 0, 1]
    direction = built.twin_from_path[:3, :3] @ [*ray.slope[0, 0], 1]
    return origin[:2] - direction[:2] * origin[2] / direction[2]


def test_without_errors_a_path_stands_where_the_ideal_one_does():
    prescription = load_prescription("camera")
    built = assemble(prescription, LEAN, NONE, np.random.default_rng(1))
    assert built.path == place(prescription)
    assert built.twin_from_pupil == pytest.approx(axis_frame(LEAN, 224.56), abs=1e-5)


def test_errors_are_drawn_with_the_stated_sizes():
    prescription = load_prescription("projector")
    rng = np.random.default_rng(2)
    drawn = [draw_path_errors(prescription, Tolerances(), rng) for _ in range(300)]
    groups = {
        0.03: np.array([list(errors.decentres.values()) for errors in drawn]),
        np.radians(0.05): np.array([list(errors.tilts.values()) for errors in drawn]),
        np.radians(0.3): np.array([errors.image_tilt for errors in drawn]),
    }
    for sd, values in groups.items():
        # Five standard errors of a standard deviation and of a mean: false alarm below 1e-6 each.
        assert values.std() == pytest.approx(sd, rel=5 / np.sqrt(2 * values.size))
        assert abs(values.mean()) < 5 * sd / np.sqrt(values.size)


@pytest.mark.parametrize("seed", range(4))
def test_paths_are_pointed_at_the_specimens_middle(seed):
    sloppy = Tolerances(pointing_mm=0)
    built = assemble(load_prescription("projector"), -LEAN, sloppy, np.random.default_rng(seed))
    assert seen_in_the_middle(built) == pytest.approx([0, 0], abs=1e-9)


@pytest.mark.slow
def test_pointing_axis_and_focus_have_the_stated_sizes():
    prescription = load_prescription("camera")
    n = 300
    aligned = Tolerances(decentre_mm=0, tilt_deg=0, image_tilt_deg=0)
    rng = np.random.default_rng(3)
    built = [assemble(prescription, LEAN, aligned, rng) for _ in range(n)]
    nominal = axis_frame(LEAN, 1.0)
    pointing = np.array([seen_in_the_middle(b) for b in built])
    axes = np.array([b.twin_from_path[:3, 2] @ nominal[:3, :2] for b in built])
    # Sliding a path sideways leaves its height.
    along = np.array([b.twin_from_path[2, 3] / b.twin_from_path[2, 2] for b in built])
    for values, sd in ((pointing, 0.05), (np.degrees(axes), 0.2), (along, 0.1)):
        # Five standard errors: false alarm below 1e-6.
        assert values.std() == pytest.approx(sd, rel=5 / np.sqrt(2 * values.size))


@pytest.mark.parametrize(
    ("name", "element", "share"),
    [
        # A specimen point in the focus of the objective moves with it: behind, its light is parallel as before.
        ("camera", "objective", 1.0),
        ("projector", "objective", 1.0),
        # The tube lens takes the image along that the objective's side forms, at magnification -0.781.
        ("camera", "tube lens", 1 / 0.781),
        ("projector", "tube lens", 1 / 0.781),
    ],
)
def test_a_decentred_element_displaces_what_the_middle_of_the_image_sees(name, element, share):
    prescription = load_prescription(name)
    shift = 0.03
    ray = chief_rays(place(prescription, PathErrors({element: (shift, 0.0)})), np.zeros((1, 2)))
    sharp = paraxial(prescription).focus_z
    assert ray.crossing(sharp)[0, 0, 0] == pytest.approx(shift * share, rel=0.01)
    assert ray.crossing(sharp)[0, 0, 1] == pytest.approx(0, abs=1e-12)


@pytest.mark.parametrize(("name", "magnification"), [("camera", -0.378791), ("projector", 0.606061)])
def test_a_tilted_sensor_or_mirror_array_tilts_the_plane_in_focus(name, magnification):
    """Scheimpflug: an image tilted by a small angle tilts the sharp plane by the angle over the magnification."""
    prescription = load_prescription(name)
    angle = 0.01
    field = np.array([[-2.0, 0.0], [2.0, 0.0]])
    points = image_points(place(prescription), field)
    straight, tilted = (
        np.mean(astigmatic_foci(place(prescription, PathErrors(image_tilt=(0.0, tilt))), points), axis=0)
        for tilt in (0.0, angle)
    )
    slope = np.diff(tilted - straight)[0] / 4.0
    assert slope == pytest.approx(-angle / magnification, rel=0.01)
