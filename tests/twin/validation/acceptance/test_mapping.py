"""Claims about the mapping of x and y, on gratings whose marks are seen where they are not."""

from types import SimpleNamespace

import numpy as np
import pytest

from greenough.pipeline.spots import Spots
from greenough.scenes.cross_grating import cross_grating
from greenough.twin.validation.acceptance import mapping


@pytest.fixture
def grating(setup, measured, by_name):
    """Rows of a grating whose marks, (n, 2) mm in its own frame, are seen as ``seen(marks)``."""

    def made(seen=lambda marks: marks, scale_sd: float = 0.0):
        part = cross_grating(3)
        rows, cols = setup.calibration.camera.shape
        nothing = np.full((4, 4, 3), np.nan)
        phase_map = SimpleNamespace(absolute=np.full((rows, cols), 0.1))  # heights are phases
        artefact = measured(part, nothing, phase_map=phase_map, scale_sd=scale_sd)
        centres = part.as_built["centres_mm"].copy()
        centres[:, :2] = seen(centres[:, :2])
        world = artefact.in_world(centres * [1, 1, 0])
        camera = setup.calibration.camera
        pixels = camera.project(
            world @ setup.calibration.camera_from_world[:3, :3].T + setup.calibration.camera_from_world[:3, 3]
        )
        n = len(centres)
        spots = Spots(pixels, np.full((n, 2), 10.0), np.full(n, 0.01))
        return by_name(mapping.rows_of_marks(setup, artefact, spots))

    return made


def test_marks_that_are_seen_where_they_are_have_no_deviation(grating):
    found = grating()
    assert set(found) == set(mapping.NAMES)
    for name in ("mapping_dx", "mapping_dy", "mapping_dx_rms", "mapping_dy_rms"):
        assert abs(found[name].value) < 0.02  # the grating's bow is not seen: cosines of it
    for name in ("alpha_x", "alpha_y"):
        assert found[name].value == pytest.approx(1, abs=1e-6)


def test_one_mark_that_is_seen_aside_fails_along_its_axis_alone(grating):
    def aside(marks):
        return marks + np.eye(len(marks))[40][:, None] * [0.0, 4e-3]

    found = grating(aside)
    assert found["mapping_dy"].value == pytest.approx(4, abs=0.1)
    assert found["mapping_dy"].holds is False
    assert found["mapping_dx"].holds


def test_a_stretched_axis_fails_by_its_amplification(grating):
    found = grating(lambda marks: marks * [1 + 1e-3, 1], scale_sd=3e-5)
    assert found["alpha_x"].value == pytest.approx(1 + 1e-3, abs=1e-6)
    assert found["alpha_x"].u == pytest.approx(3e-5, rel=0.05)  # what the axis errs by does not excuse it
    assert found["alpha_x"].holds is False


def test_a_skewed_axis_fails_by_the_squareness(grating):
    found = grating(lambda marks: marks + marks[:, ::-1] * [4e-4, 0])
    assert found["squareness_xy"].value == pytest.approx(-4e-4, abs=2e-6)
    assert found["squareness_xy"].holds is False
    assert found["alpha_x"].value == pytest.approx(1, abs=1e-6)


def test_what_a_similarity_cannot_take_out_of_a_stretch_is_deviation(grating):
    found = grating(lambda marks: marks * [1 + 1e-3, 1])
    # What a similarity cannot take out: half of it along x, minus half along y.
    assert found["mapping_dx_rms"].value > 0.5


def test_a_scale_within_the_board_s_certificate_holds_and_is_no_deviation(grating):
    found = grating(lambda marks: marks * (1 + 6e-5), scale_sd=3e-5)
    assert found["alpha_x"].u == pytest.approx(3e-5, rel=0.03)
    for name in ("alpha_x", "alpha_y"):
        assert found[name].value == pytest.approx(1 + 6e-5, abs=1e-6)
        assert found[name].holds
    assert found["mapping_dx_rms"].value < 0.02
    assert grating(lambda marks: marks * (1 + 2e-4), scale_sd=3e-5)["alpha_y"].holds is False
