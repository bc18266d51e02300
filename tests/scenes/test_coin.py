"""Claims about the coin."""

import numpy as np
import pytest
from scipy.ndimage import label

from greenough.scenes.coin import BEVEL_MM, RELIEF_MM, SIZE_MM, STEP_MM, coin, relief


@pytest.fixture(scope="module")
def specimen():
    return coin()


def axes(step: float):
    return tuple((np.arange(round(size / step)) + 0.5) * step - size / 2 for size in SIZE_MM)


def test_heights_span_three_tenths_of_a_millimetre_around_zero(specimen):
    z = specimen.parts[0].vertices[:, 2]
    np.testing.assert_allclose([z.min(), z.max()], [-0.15, 0.15], atol=1e-9)
    # The tilt foreshortens by less than 0.1 %.
    np.testing.assert_allclose(np.ptp(specimen.parts[0].vertices[:, :2], axis=0), SIZE_MM, rtol=1e-3)


def test_the_relief_has_flat_tops_and_a_flat_ground():
    height, gradient = relief(*axes(0.02))
    assert height.min() == 0
    np.testing.assert_allclose(height.max(), RELIEF_MM)
    flat = np.linalg.norm(gradient, axis=-1) < 1e-12
    assert set(np.unique(np.round(height[flat], 12))) == {0, RELIEF_MM}
    assert (flat & (height > RELIEF_MM / 2)).mean() > 0.05
    assert (flat & (height < RELIEF_MM / 2)).mean() > 0.2


def test_letters_and_rim_stand_where_they_should():
    x = np.array([-2.8, 0.0, 2.8])  # middles of G, E and N
    height, _ = relief(x, np.array([-2.65, 0.45, 1.475, 2.5]))
    np.testing.assert_allclose(height[0, 1], RELIEF_MM)  # rim under the middle
    np.testing.assert_allclose(height[1], 0)  # between the lines
    np.testing.assert_allclose(height[2, 2], RELIEF_MM)  # the middle of N lies on its diagonal
    np.testing.assert_allclose(height[3], 0)


def test_letters_and_rim_are_wholly_on_the_piece_and_apart():
    x, y = axes(0.02)
    height, _ = relief(x, y)
    np.testing.assert_array_equal(height[[0, -1]], 0)
    lumps = np.empty(height.shape, np.int32)
    assert label(height > RELIEF_MM / 2, output=lumps) == 1 + len("GREEN") + len("1892")
    at_the_sides = set(lumps[:, [0, -1]].ravel()) - {0}
    assert at_the_sides == {lumps[np.argmin(np.abs(y + 2.65)), len(x) // 2]}  # only the rim goes on beyond the piece


def test_the_gradient_is_that_of_the_heights():
    x, y = axes(0.05)
    _, gradient = relief(x, y)
    d = 1e-6
    by_x = (relief(x + d, y)[0] - relief(x - d, y)[0]) / (2 * d)
    by_y = (relief(x, y + d)[0] - relief(x, y - d)[0]) / (2 * d)
    np.testing.assert_allclose(gradient, np.stack([by_x, by_y], axis=-1), atol=1e-4)


def test_bevels_are_nowhere_steeper_than_one_stroke_s():
    _, gradient = relief(*axes(0.02))
    assert np.linalg.norm(gradient, axis=-1).max() <= RELIEF_MM * np.pi / 2 / BEVEL_MM * (1 + 1e-12)


@pytest.mark.slow
def test_facets_depart_from_the_relief_by_less_than_a_tenth_of_a_micrometre(specimen):
    # On a height field with right-angled facets the largest error is in the middle of an edge.
    x, y = (np.linspace(-0.5, 0.5, round(size / STEP_MM) + 1) * size for size in SIZE_MM)
    height, _ = relief(x, y)
    assert height.size == len(specimen.parts[0].vertices)
    mid_x, mid_y = (x[1:] + x[:-1]) / 2, (y[1:] + y[:-1]) / 2
    errors = [
        relief(mid_x, mid_y)[0] - (height[1:, 1:] + height[:-1, :-1]) / 2,
        relief(mid_x, y)[0] - (height[:, 1:] + height[:, :-1]) / 2,
        relief(x, mid_y)[0] - (height[1:] + height[:-1]) / 2,
    ]
    assert max(np.abs(error).max() for error in errors) < 1e-4
