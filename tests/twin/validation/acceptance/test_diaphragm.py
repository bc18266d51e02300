"""Claims about the diaphragm's profiles, strokes and volumes, on films whose errors are known."""

import numpy as np
import pytest

from greenough.scenes.diaphragm import DEFLECTION_MM, OUTER_RADIUS_MM, diaphragm, surface
from greenough.twin.validation.acceptance import diaphragm as evaluation


@pytest.fixture(scope="module")
def films():
    return {state: diaphragm(state) for state in evaluation.STATES}


@pytest.fixture
def states(setup, measured, grid, by_name, films):
    """Rows of the three states, of which the raised one is measured ``higher`` mm too high inside the clamp."""

    def made(higher: float = 0.0, everywhere: float = 0.0):
        x, y = grid(7.6, 6.4, 0.02)
        radius = np.hypot(x, y)
        artefacts = {}
        for state, film in films.items():
            z = surface(radius, np.arctan2(y, x), DEFLECTION_MM[state])[0]
            true = np.stack([x, y, np.where(radius < OUTER_RADIUS_MM, z, np.nan)], axis=-1)
            errors = everywhere + np.where(radius < 3.4, higher if state == "raised" else 0.0, 0.0)
            artefacts[state] = measured(film, true, errors=errors)
        return by_name(evaluation.rows_of_states(setup, artefacts))

    return made


def test_films_that_are_measured_as_they_are_hold(states):
    found = states()
    assert set(found) == set(evaluation.NAMES)
    assert all(row.holds for row in found.values())
    # 2.76 mm between the extreme states, over what a clamped plate keeps of it.
    assert found["diaphragm_stroke_concave_raised"].value == pytest.approx(2.76, abs=0.02)


def test_a_film_that_seems_raised_too_far_fails_by_stroke_volume_and_profile(states):
    found = states(higher=6e-3)
    for other in ("concave", "equilibrated"):
        stroke = found[f"diaphragm_stroke_{other}_raised"]
        assert stroke.value - stroke.peer == pytest.approx(6e-3, abs=1e-3)
        volume = found[f"diaphragm_volume_{other}_raised"]
        assert volume.value - volume.peer == pytest.approx(1.5 * volume.limit, rel=0.05)
        assert stroke.holds is False
        assert volume.holds is False
    assert found["diaphragm_profile_row_raised"].holds is False
    assert found["diaphragm_stroke_concave_equilibrated"].holds


def test_a_shift_of_the_whole_is_no_error_of_the_shape(states):
    found = states(everywhere=8e-3)
    assert all(row.holds for row in found.values())
