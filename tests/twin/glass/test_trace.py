"""Claims about the tracing of rays. Directions and points are compared with optiland's and with stored rays."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from greenough.twin.glass.placed import PathErrors, PlacedPath, place
from greenough.twin.glass.prescription import load_prescription
from greenough.twin.glass.trace import Double, Rays, at_height, land, sharp_rims, trace
from greenough.twin.renderer import mi

IMAGE_MM, DIRECTION = 1e-4, 1e-6  # what tracers may differ by


def field_of(path: PlacedPath) -> tuple[float, float]:
    """Half width and half height on the specimen, to the nearest 0.1 mm."""
    return {"camera": (6.3, 4.7), "projector": (5.4, 3.0)}[path.prescription.name]


def random_rays(path: PlacedPath, n: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Points (n, 3) over field and depth, and unit directions (n, 3) to points of the entrance pupil."""
    rng = np.random.default_rng(seed)
    half = field_of(path)
    points = rng.uniform([-half[0], -half[1], -1.5], [half[0], half[1], 1.5], (n, 3))
    radius, angle = 3.36 * np.sqrt(rng.uniform(size=n)), rng.uniform(0, 2 * np.pi, n)
    pupil = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.full(n, 224.56)], axis=1)
    directions = pupil - points
    return points, directions / np.linalg.norm(directions, axis=1, keepdims=True)


def as_rays(points, directions, real=Double):
    return Rays(*(real(c) for c in points.T), *(real(c) for c in directions.T))


def traced(path, points, directions, wavelength_um, real=Double):
    rays, passed = trace(path, as_rays(points, directions, real), wavelength_um, outwards=True)
    met = np.stack([np.array(c, float) for c in land(path.image, rays)], axis=1)
    return met, np.stack([np.array(c, float) for c in rays[3:]], axis=1), np.array(passed)


@pytest.mark.parametrize("wavelength_um", [0.510, 0.525, 0.540])
@pytest.mark.parametrize("real", [Double, mi.Float], ids=["double", "single"])
def test_designed_paths_are_traced_as_optiland_does(designed, optiland_trace, wavelength_um, real):
    points, directions = random_rays(designed, 500, seed=1)
    ours, our_directions, passed = traced(designed, points, directions, wavelength_um, real)
    theirs, their_directions = optiland_trace(designed, points, directions, wavelength_um)
    assert passed.all()
    assert np.abs(ours - theirs).max() < (1e-9 if real is Double else IMAGE_MM)
    assert np.abs(our_directions - their_directions).max() < (1e-12 if real is Double else DIRECTION)


@pytest.mark.parametrize("real", [Double, mi.Float], ids=["double", "single"])
def test_paths_out_of_alignment_are_traced_as_optiland_does(built, optiland_trace, real):
    points, directions = random_rays(built, 500, seed=2)
    ours, our_directions, _ = traced(built, points, directions, 0.525, real)
    theirs, their_directions = optiland_trace(built, points, directions, 0.525)
    assert np.abs(ours - theirs).max() < (1e-9 if real is Double else IMAGE_MM)
    assert np.abs(our_directions - their_directions).max() < (1e-12 if real is Double else DIRECTION)


def test_designed_paths_reproduce_the_stored_rays(designed):
    table = np.genfromtxt(Path(__file__).with_name("reference_rays.csv"), delimiter=",", names=True, dtype=None)
    rows = table[table["path"] == designed.prescription.name]
    columns = {name: rows[name].astype(float) for name in rows.dtype.names[1:]}
    start = Rays(*(Double(columns[name]) for name in ("x", "y", "z", "l", "m", "n")))
    rays, _ = trace(designed, start, Double(columns["wavelength_nm"] * 1e-3), outwards=True)
    for name, ours in zip(("image_x", "image_y"), land(designed.image, rays), strict=True):
        assert np.array(ours) == pytest.approx(columns[name], abs=1e-11)
    for name, ours in zip(("image_l", "image_m", "image_n"), rays[3:], strict=True):
        assert np.array(ours) == pytest.approx(columns[name], abs=1e-13)


def test_single_precision_costs_nanometres_on_the_specimen(built):
    points, directions = random_rays(built, 4000, seed=3)
    # The same numbers for both: what counts is the arithmetic.
    points, directions = points.astype(np.float32), directions.astype(np.float32)
    directions = directions.astype(float) / np.linalg.norm(directions.astype(float), axis=1, keepdims=True)
    magnification = 0.379 if built.prescription.name == "camera" else 0.606
    single, _, _ = traced(built, points, directions.astype(np.float32), 0.525, mi.Float)
    double, _, _ = traced(built, points, directions.astype(np.float32).astype(float), 0.525)
    miss_nm = np.abs(single - double) / magnification * 1e6
    assert np.sqrt(np.mean(miss_nm**2)) < 10
    assert miss_nm.max() < 50


@pytest.mark.parametrize("real", [Double, mi.Float], ids=["double", "single"])
def test_light_runs_back_the_way_it_came(built, real):
    points, directions = random_rays(built, 300, seed=4)
    there, _ = trace(built, as_rays(points, directions, real), 0.525, outwards=True)
    back, _ = trace(built, Rays(*there[:3], *(-c for c in there[3:])), 0.525, outwards=False)
    # Coordinates of the plane z = 0, where rays of both directions are compared.
    ours = np.stack([np.array(c, float) for c in at_height(back, 0.0)], axis=1)
    start = points[:, :2] - points[:, 2:] * directions[:, :2] / directions[:, 2:]
    assert np.abs(ours - start).max() < (1e-11 if real is Double else IMAGE_MM)


@settings(max_examples=25)
@given(
    name=st.sampled_from(["camera", "projector"]),
    turn=st.floats(0, 2 * np.pi),
    x=st.floats(-6, 6), z=st.floats(-1.5, 1.5), slope_x=st.floats(-0.014, 0.014), slope_y=st.floats(-0.014, 0.014),
)  # fmt: skip
def test_a_turned_object_has_a_turned_image(name, turn, x, z, slope_x, slope_y):
    path = place(load_prescription(name))
    point = np.array([x, 0.0, z])
    direction = np.array([slope_x - x / 224.56, slope_y, 1.0])
    direction /= np.linalg.norm(direction)
    rotation = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
    met, *_ = traced(path, np.array([point, rotation @ point]), np.array([direction, rotation @ direction]), 0.525)
    assert met[1] == pytest.approx(rotation[:2, :2] @ met[0], abs=1e-12)


@pytest.mark.slow
@settings(max_examples=10)
@given(
    tilt=st.floats(-0.02, 0.02),
    decentre=st.floats(-0.2, 0.2),
    element=st.sampled_from(["objective", "changer, positive", "tube lens"]),
)
def test_mirrored_errors_mirror_the_image(tilt, decentre, element):
    prescription = load_prescription("camera")
    points, directions = random_rays(place(prescription), 20, seed=6)
    # A reflection in x = 0 turns tilts about y round, and leaves those about x.
    path = place(prescription, PathErrors({element: (decentre, 0.1)}, {element: (0.003, tilt)}, (0.01, -tilt)))
    mirrored = place(prescription, PathErrors({element: (-decentre, 0.1)}, {element: (0.003, -tilt)}, (0.01, tilt)))
    mirror = np.array([-1.0, 1.0, 1.0])
    met, *_ = traced(path, points, directions, 0.525)
    met_mirrored, *_ = traced(mirrored, mirror * points, mirror * directions, 0.525)
    assert met_mirrored == pytest.approx(mirror[:2] * met, abs=1e-11)


def test_a_shifted_path_shifts_nothing_but_its_coordinates():
    """All elements and the image displaced together see a displaced specimen as before."""
    prescription = load_prescription("camera")
    shift = (0.4, -0.3)
    path = place(prescription, PathErrors({element: shift for element in prescription.elements}))
    points, directions = random_rays(path, 50, seed=7)
    met, *_ = traced(place(prescription), points, directions, 0.525)
    met_shifted, *_ = traced(path, points + np.array([*shift, 0.0]), directions, 0.525)
    assert met_shifted - shift == pytest.approx(met, abs=1e-11)


def test_rims_cut_off_what_lies_outside_and_a_soft_rim_half_of_what_meets_it(designed):
    k = 2  # the objective's last surface, and rays that run parallel to the axis
    rim = designed.surfaces[0].semi_diameter
    x = np.array([0.0, 0.5 * rim, 0.999 * rim, 1.001 * rim, 3 * rim])
    points = np.stack([x, 0 * x, 0 * x], axis=1)
    start = as_rays(points, np.tile([0.0, 0.0, 1.0], (5, 1)))
    _, sharp = trace(designed, start, 0.525, outwards=True, surfaces=[0], rims=sharp_rims(designed))
    assert np.array(sharp).tolist() == [1, 1, 1, 0, 0]
    _, soft = trace(designed, start, 0.525, outwards=True, surfaces=[0], rims={0: 0.2 * rim})
    assert np.array(soft)[[0, 1, 4]].tolist() == [1, 1, 0]
    assert np.array(soft)[2:4] == pytest.approx([0.505, 0.495])
    _, without = trace(designed, start, 0.525, outwards=True, surfaces=[0], rims={k: 0.0})
    assert np.array(without).all()


def test_rays_that_miss_a_surface_do_not_pass(designed):
    beyond = abs(1 / designed.surfaces[3].curvature) + 1  # the changer's first surface is a sphere of that radius
    start = as_rays(np.array([[beyond, 0.0, 120.0]]), np.array([[0.0, 0.0, 1.0]]))
    _, passed = trace(designed, start, 0.525, outwards=True, surfaces=[3])
    assert np.array(passed).tolist() == [0]
