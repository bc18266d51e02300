import numpy as np
import pytest

from greenough.pipeline.local_planes import LocalPlanes

SHAPE = (60, 80)
SIGMA_PX = 1.8


def plane() -> np.ndarray:
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]]
    return 2.0 + 0.3 * u - 0.1 * v


def test_a_plane_stays_a_plane_under_any_weights_up_to_the_edges():
    weight = np.random.default_rng(1).lognormal(0, 3, SHAPE)
    weight[20:40, 30:50] = 0
    values = np.where(weight > 0, plane(), 1e3)
    near = LocalPlanes.under(weight, SIGMA_PX).fit(values)
    known = weight > 0
    np.testing.assert_allclose(near[known], plane()[known], atol=1e-6)


def test_far_from_anything_known_values_stay():
    weight = np.zeros(SHAPE)
    weight[:, :10] = 1
    values = np.where(weight > 0, plane(), 7.0)
    assert np.all(LocalPlanes.under(weight, SIGMA_PX).fit(values)[:, 40:] == 7.0)


def test_even_noise_shrinks_as_under_the_gaussian_itself():
    """White noise through a Gaussian of sigma s keeps 1 / (2 s √π) of its sd: even weights make the slopes decouple.

    3136 pixels in patches of 4 π s² = 41: 77 independent values, whose sd is known to 8 %; five of these.
    """
    noise = np.random.default_rng(2).standard_normal((80, 80))
    inner = slice(12, -12)
    kept = LocalPlanes.under(np.ones((80, 80)), SIGMA_PX).fit(noise)[inner, inner].std()
    assert kept == pytest.approx(1 / (2 * SIGMA_PX * np.sqrt(np.pi)), rel=0.4)


def test_the_stated_variance_is_the_scatter_under_uneven_weights_and_at_holes():
    """400 draws of 4 800 values: their mean square is known to below 1 % although neighbours share their noise.

    4 800 values in patches of 4 π s² = 41 are at least 117 independent ones, times 400: sqrt(2 / 46 800) = 0.7 %, and
    five of these for the mean; a single pixel's sd is known to 3.5 %, and six of these for the worst of them.
    """
    rng = np.random.default_rng(4)
    sd = rng.lognormal(0, 1, SHAPE)
    weight = sd**-2
    weight[20:40, 30:50] = 0
    known = weight > 0
    planes = LocalPlanes.under(weight, SIGMA_PX)
    stated = planes.variance(sd**2)[known]
    scatter = np.mean([planes.fit(sd * rng.standard_normal(SHAPE))[known] ** 2 for _ in range(400)], axis=0)
    assert np.mean(scatter / stated) == pytest.approx(1.0, abs=0.035)
    assert np.abs(np.sqrt(scatter / stated) - 1).max() < 0.21
