"""Claims about flatness errors, on planes whose errors are known."""

import numpy as np
import pytest

from greenough.scenes.plane import plane
from greenough.twin.validation.acceptance import flatness


@pytest.fixture
def planes(setup, measured, grid, by_name):
    """Rows of planes of which the first is measured with a wave of an amplitude in mm."""

    def made(amplitude: float = 0.0, seed: int = 0):
        x, y = grid(4.0, 3.0, 0.02)
        true = np.stack([x, y, 0 * x], axis=-1)
        waves = dict.fromkeys(flatness.PLACES, 0.0) | {"low": amplitude}
        artefacts = {
            place: measured(plane(), true, errors=wave * np.cos(2 * np.pi * x), seed=seed + k)
            for k, (place, wave) in enumerate(waves.items())
        }
        return by_name(flatness.rows_of_planes(setup, artefacts))

    return made


def test_there_are_six_places_and_all_names_come(planes):
    assert len(flatness.PLACES) == 6
    assert set(planes()) == set(flatness.NAMES)


def test_of_a_perfect_plane_only_noise_is_left_and_it_is_the_one_that_was_stated(planes):
    """The width of 95 % of 30 000 points is known to 0.8 %, so that 4 % happens by chance less than once in 1e5."""
    found = planes()
    for place in flatness.PLACES:
        assert found[f"flatness_95_{place}"].ratio == pytest.approx(1, abs=0.04)
    assert all(row.holds for row in found.values())


def test_a_bent_plane_fails_and_is_the_largest(planes):
    found = planes(amplitude=6e-3)
    bent, largest = found["flatness_95_low"], found["flatness_95_largest"]
    assert bent.holds is False
    assert bent.ratio > 2
    assert (largest.value, largest.holds) == (bent.value, False)
    assert found["flatness_95_high"].holds
