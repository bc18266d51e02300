"""Claims about prescriptions and the files they come from."""

import re
from pathlib import Path

import numpy as np
import pytest

import greenough.twin.glass.prescription as prescription
from greenough.instrument.errors import InputError
from greenough.twin.glass.prescription import load_prescription

CAMERA = Path(prescription.__file__).with_name("camera.toml")


def test_vertices_are_sums_of_distances(designed):
    lens = designed.prescription
    assert lens.vertices[0] == lens.working_distance
    assert np.diff(lens.vertices) == pytest.approx([surface.thickness for surface in lens.surfaces])


def test_every_surface_but_the_stop_belongs_to_one_element(designed):
    lens = designed.prescription
    members = sorted(k for numbers in lens.elements.values() for k in numbers)
    assert members == [k for k in range(len(lens.surfaces)) if k != lens.stop]
    assert all(len(numbers) == 3 for numbers in lens.elements.values())  # cemented doublets


def test_a_path_may_be_read_from_any_file(tmp_path):
    copy = tmp_path / "mine.toml"
    copy.write_text(CAMERA.read_text())
    assert load_prescription(copy) == load_prescription("camera")


@pytest.mark.parametrize(
    ("written", "instead", "said"),
    [
        ("radius = 125.73", 'radius = "flat"', r"surfaces.*radius"),
        ('glass = "N-BK7"', 'glass = "N-BK77"', r"glass: must be one of air, N-BK7, .*not 'N-BK77'"),
        (", is_stop = true", "", "exactly one surface must have is_stop = true, not 0"),
        ("semi_diameter = 3.5", "semi_diameter = 0", "semi_diameter = 0 must be a number above 0"),
        ("semi_diameter = 3.5", "semidiameter = 3.5", r"semidiameter"),
        ('radius = 0, thickness = 73.22, glass = "air"', 'radius = 9, thickness = 73.22, glass = "air"', "the stop"),
        ('thickness = 57.7994, glass = "air"', 'thickness = 57.7994, glass = "N-BK7"', "the image must lie in air"),
        ("working_distance = 93.94", "working_distance = ", "no TOML"),
    ],
)
def test_a_file_that_no_lens_can_follow_is_refused_in_one_sentence(tmp_path, written, instead, said):
    text = CAMERA.read_text()
    assert written in text
    file = tmp_path / "wrong.toml"
    file.write_text(text.replace(written, instead, 1))
    with pytest.raises(InputError, match=r"wrong\.toml") as refusal:
        load_prescription(file)
    assert re.search(said, str(refusal.value))
    assert "\n" not in str(refusal.value)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(InputError, match=r"cannot read prescription .*none\.toml; choose one of camera, projector"):
        load_prescription(tmp_path / "none.toml")
