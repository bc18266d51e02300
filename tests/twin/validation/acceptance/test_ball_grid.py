"""Claims about the inspection of a ball grid array whose points are known."""

import numpy as np
import pytest

from greenough.scenes.bga import defective_bga
from greenough.twin.validation.acceptance import ball_grid

PIXEL_MM = 0.02


@pytest.fixture
def array(setup, measured, grid, by_name):
    """Rows of the defective array, some of whose balls (row, col) are measured higher by so many mm, or not at all."""

    def made(higher=None, gone=()):
        part = defective_bga(3)
        built = part.as_built
        x, y = grid(7.2, 6.0, PIXEL_MM)
        z = np.full(x.shape, part.nominal["substrate_z_mm"])
        points_z = z.copy()
        balls = zip(built["ball_row"], built["ball_col"], built["ball_centres_mm"], built["ball_radii_mm"], strict=True)
        for row, col, centre, radius in balls:
            square = radius**2 - (x - centre[0]) ** 2 - (y - centre[1]) ** 2
            on_ball = square > 0
            z[on_ball] = centre[2] + np.sqrt(square[on_ball])
            if (row, col) not in gone:
                points_z[on_ball] = z[on_ball] + (higher or {}).get((row, col), 0.0)
        true, points = (np.stack([x, y, each], axis=-1) for each in (z, points_z))
        return by_name(ball_grid.rows_of_array(setup, measured(part, true, points=points)))

    return made


@pytest.mark.slow
def test_an_array_that_is_measured_as_it_is_holds(array):
    found = array()
    assert set(found) == set(ball_grid.NAMES)
    assert all(row.holds for row in found.values()), [row for row in found.values() if not row.holds]
    assert "1 are missing" in found["bga_missing"].criterion
    assert "1 are low" in found["bga_low"].criterion


@pytest.mark.slow
def test_a_ball_that_is_not_seen_and_a_low_one_that_seems_as_high_as_the_others_are_called_wrongly(array):
    found = array(gone=[(5, 5)], higher={(4, 6): 0.08})
    for name in ("bga_missing", "bga_low"):
        assert found[name].value == 1
        assert found[name].holds is False


@pytest.mark.slow
def test_a_ball_that_is_measured_too_high_changes_the_coplanarity_and_the_apexes(array):
    found = array(higher={(0, 0): 0.1})
    assert abs(found["bga_regression_coplanarity"].value) > 4
    assert found["bga_regression_coplanarity"].holds is False
    assert found["bga_apex_height_mean"].value == pytest.approx(100 / 62, abs=0.3)


@pytest.mark.slow
def test_diameters_are_judged_by_caps_of_45_degrees_and_smaller_ones_only_report(array, monkeypatch):
    assert array()["bga_diameter_mean"].limit == pytest.approx(5.0)
    monkeypatch.setattr(ball_grid, "LEAST_CAP_DEG", 80.0)  # more than is looked at
    found = array()
    assert found["bga_diameter_mean"].holds is None
    assert "not judged under caps of 80 degrees, a rule that was made after" in found["bga_diameter_mean"].criterion
    assert found["bga_apex_height_mean"].holds
