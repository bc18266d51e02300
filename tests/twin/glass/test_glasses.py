"""Claims about refractive indices."""

import pytest

from greenough.twin.glass.glasses import AIR, GLASSES, index

D, F, C = 0.5875618, 0.4861327, 0.6562725  # Fraunhofer's lines, µm


# The catalogue's six-digit index at the d line and Abbe number, which are tabulated apart from the formula.
@pytest.mark.parametrize(
    ("glass", "at_d", "abbe"),
    [("N-BK7", 1.51680, 64.17), ("N-SF5", 1.67271, 32.25), ("N-BAF10", 1.67003, 47.11), ("N-SF6", 1.80518, 25.36)],
)
def test_index_and_dispersion_are_the_catalogues(glass, at_d, abbe):
    assert index(glass, D) == pytest.approx(at_d, abs=6e-6)
    assert (index(glass, D) - 1) / (index(glass, F) - index(glass, C)) == pytest.approx(abbe, abs=6e-3)


def test_blue_is_refracted_most():
    for glass in GLASSES:
        assert index(glass, 0.45) > index(glass, 0.55) > index(glass, 0.65) > 1


def test_air_refracts_nothing():
    assert index(AIR, 0.525) == 1
