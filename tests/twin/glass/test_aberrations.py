"""Claims about aberrations: the design's figures, which another program traced, and a peer's spots."""

import numpy as np
import pytest

from greenough.twin.glass.aberrations import (
    astigmatic_foci,
    best_focus,
    chief_rays,
    distortion,
    image_points,
    lateral_colour,
    pencils,
    rms_radius,
    stop_points,
    vignetting,
)
from greenough.twin.glass.paraxial import paraxial

# From rays of the specimen's z = 0 at these radii; ours start at the image points that belong to them.
DESIGN = {
    "camera": {
        "field": [1.98, 3.95, 5.53, 6.71, 7.90],
        "distortion_percent": [-0.019, -0.078, -0.152, -0.224, -0.310],
        "colour_510_um": [0.110, 0.218, 0.303, 0.365, 0.425],
        "colour_540_um": [0.005, 0.012, 0.018, 0.025, 0.033],
        "rms_at_zero_um": [2.47, 1.92, 1.97, 2.76, 4.11],
        "rms_at_best_um": [0.52, 1.11, 1.92, 2.69, 3.62],
        "best_z": [0.223, 0.141, 0.036, -0.067, -0.191],
        "passed": [1.0, 1.0, 1.0, 1.0, 0.922],
        "coma_um": [0.438, 0.873, 1.215, 1.467, 1.715],
    },
    "projector": {
        "field": [1.57, 3.15, 4.41, 5.35, 6.30],
        "distortion_percent": [0.013, 0.052, 0.101, 0.148, 0.204],
        "colour_510_um": [0.076, 0.121, 0.113, 0.069, -0.014],
        "colour_540_um": [-0.206, -0.384, -0.487, -0.533, -0.543],
        "rms_at_zero_um": [2.66, 2.42, 2.40, 2.72, 3.45],
        "rms_at_best_um": [0.39, 0.97, 1.74, 2.50, 3.44],
        "best_z": [0.242, 0.203, 0.150, 0.096, 0.028],
        "passed": [1.0, 1.0, 1.0, 1.0, 0.928],
        "coma_um": [0.337, 0.662, 0.907, 1.078, 1.235],
    },
}


@pytest.fixture
def design(designed):
    return {name: np.array(values) for name, values in DESIGN[designed.prescription.name].items()}


@pytest.fixture
def points(designed, design):
    return image_points(designed, np.stack([design["field"], 0 * design["field"]], axis=1))


def test_distortion_is_the_designs(designed, design, points):
    field, distorted = distortion(designed, points)
    # Ours stands at the field that the image point really sees: cubic distortion there.
    at = np.linalg.norm(field, axis=1)
    expected = design["distortion_percent"] * (at / design["field"]) ** 2
    assert 100 * distorted == pytest.approx(expected, abs=2e-3)


def test_lateral_colour_is_the_designs(designed, design, points):
    blue, red = 1e3 * lateral_colour(designed, points, np.array([0.510, 0.540]))
    assert blue == pytest.approx(design["colour_510_um"], abs=6e-3)
    assert red == pytest.approx(design["colour_540_um"], abs=6e-3)


def test_spots_and_best_focus_are_the_designs(designed, design, points):
    bundle = pencils(designed, points, stop_points(20))
    focus = best_focus(bundle)
    assert focus == pytest.approx(design["best_z"], abs=0.012)
    assert 1e3 * rms_radius(bundle, focus) == pytest.approx(design["rms_at_best_um"], abs=0.07)
    assert 1e3 * rms_radius(bundle, 0.0) == pytest.approx(design["rms_at_zero_um"], abs=0.08)


def test_coma_is_the_designs(designed, design, points):
    """The centroid of the light from a point of the image lies inwards by what the image's centroid lies outwards."""
    centroid = pencils(designed, points, stop_points(20)).at_zero.mean(axis=1)
    offset = centroid - chief_rays(designed, points).at_zero[:, 0]
    inwards = -np.sum(offset * centroid, axis=1) / np.linalg.norm(centroid, axis=1)
    assert 1e3 * inwards == pytest.approx(design["coma_um"], abs=0.02)


def test_rims_pass_the_designs_share_of_the_light(designed, design, points):
    assert vignetting(designed, points) == pytest.approx(design["passed"], abs=6e-3)


def test_spots_are_smaller_than_airys_disc_all_over_the_field(designed):
    """At best focus, on a grid that reaches into the corners, at the middle and at the half widths of the spectrum."""
    image = designed.prescription.image
    grid = np.stack(np.meshgrid(np.linspace(-0.5, 0.5, 7), np.linspace(-0.5, 0.5, 5)), axis=-1).reshape(-1, 2)
    na = paraxial(designed.prescription).na
    for wavelength in (0.510, 0.525, 0.540):
        bundle = pencils(designed, grid * [image.width, image.height], stop_points(8), wavelength)
        assert rms_radius(bundle, best_focus(bundle)).max() < 0.61e-3 * wavelength / na


def test_astigmatism_parts_the_foci_and_leaves_the_axis_sharp(designed):
    field = paraxial(designed.prescription)
    tangential, sagittal = astigmatic_foci(designed, image_points(designed, [[1e-6, 0], [2.0, 0.0], [0.0, 4.0]]))
    assert tangential[0] == pytest.approx(field.focus_z, abs=1e-4)
    assert sagittal[0] == pytest.approx(field.focus_z, abs=1e-4)
    # Third order: both depart from the axis as the square of the field.
    assert (tangential[2] - field.focus_z) / (tangential[1] - field.focus_z) == pytest.approx(4, rel=0.06)
    assert (sagittal[2] - field.focus_z) / (sagittal[1] - field.focus_z) == pytest.approx(4, rel=0.06)


@pytest.mark.parametrize("rings", [1, 5, 20])
def test_stop_points_stand_for_equal_areas(rings):
    disk = stop_points(rings)
    assert len(disk) == 3 * rings * (rings + 1) + 1
    assert np.linalg.norm(disk, axis=1).max() < 1
    # A uniform disk has mean 0 and mean square 1/2; equal weights are good to the square of a ring's width.
    assert disk.mean(axis=0) == pytest.approx([0, 0], abs=1e-12)
    assert np.mean(np.sum(disk**2, axis=1)) == pytest.approx(0.5, abs=0.25 / rings**2)
