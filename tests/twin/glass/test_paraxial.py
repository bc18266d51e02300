"""Claims about first-order optics: figures of the design, which another program computed, and of the paper."""

import numpy as np
import pytest

from greenough.twin.glass.paraxial import marginal_heights, paraxial
from greenough.twin.glass.prescription import load_prescription

DESIGN = {
    "camera": {
        "magnification": -0.378791, "focal_length": 91.487, "pinhole_focal_length": 85.0613,
        "pinhole_focal_length_px": (22683.0, 22683.0), "px_per_mm": (101.01, 101.01), "focus_z": 0.313,
        "specimen_to_image": 338.49, "na": 0.015, "na_image": 0.0396,
    },
    "projector": {
        "magnification": 0.606061, "focal_length": -42.421, "pinhole_focal_length": 136.0971,
        "pinhole_focal_length_px": (12590.8, 25166.4), "px_per_mm": (56.07, 112.07), "focus_z": 0.208,
        "specimen_to_image": 619.08, "na": 0.015, "na_image": 0.0247,
    },
}  # fmt: skip
EXIT_PUPIL_BEHIND_IMAGE = {"camera": 459.37, "projector": -37.39}


def half_a_digit(value: float) -> float:
    """Of a figure as it is written, half a unit of its last digit and a little for the figures it was rounded from."""
    decimals = len(repr(value).partition(".")[2])
    return 0.51 * 10.0**-decimals


@pytest.mark.parametrize("name", ["camera", "projector"])
def test_summary_is_the_designs(name):
    summary = paraxial(load_prescription(name))
    for quantity, values in DESIGN[name].items():
        ours = np.atleast_1d(getattr(summary, quantity))
        for value, our in zip(np.atleast_1d(values).tolist(), ours, strict=True):
            assert our == pytest.approx(value, abs=half_a_digit(value)), quantity
    assert summary.entrance.z == pytest.approx(224.56, abs=5e-5)
    assert 2 * summary.entrance.radius == pytest.approx(6.7376, rel=3e-4)  # the design's is that of a real ray
    behind = summary.exit.z - summary.specimen_to_image
    assert behind == pytest.approx(EXIT_PUPIL_BEHIND_IMAGE[name], abs=6e-3)


def test_camera_is_the_papers_pinhole_within_half_a_percent():
    """Table 2: fx = 22683.6612 px and T_z = 224.5595 mm, the projection centre's distance."""
    summary = paraxial(load_prescription("camera"))
    assert summary.pinhole_focal_length_px[0] == pytest.approx(22683.6612, rel=5e-3)
    assert summary.entrance.z == pytest.approx(224.5595, rel=5e-3)


@pytest.mark.parametrize("name", ["camera", "projector"])
def test_pupils_are_images_of_each_other(name):
    """Lagrange's invariant: NA times size is the same on both sides, up to the image's distance from its focus."""
    summary = paraxial(load_prescription(name))
    assert summary.na_image * abs(summary.magnification) == pytest.approx(summary.na, rel=3e-3)


@pytest.mark.parametrize("name", ["camera", "projector"])
def test_light_is_parallel_between_objective_and_tube_lens(name):
    """The design's instrument: an afocal changer that magnifies 1 / 0.5072 times between two collimated beams."""
    heights = marginal_heights(load_prescription(name))
    assert heights[2] == pytest.approx(heights[3], rel=1e-3)
    assert heights[9] == pytest.approx(heights[10], rel=1e-3)
    assert heights[3] / heights[9] == pytest.approx(0.5072, rel=2e-3)
    assert heights[9] == pytest.approx(2.857)
