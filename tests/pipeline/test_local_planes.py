import numpy as np
import pytest

from greenough.pipeline.local_planes import fit_local_planes

SHAPE = (60, 80)
SIGMA_PX = 1.8


def plane() -> np.ndarray:
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]]
    return 2.0 + 0.3 * u - 0.1 * v


def test_a_plane_stays_a_plane_under_any_weights_up_to_the_edges():
    weight = np.random.default_rng(1).lognormal(0, 3, SHAPE)
    weight[20:40, 30:50] = 0
    values = np.where(weight > 0, plane(), 1e3)
    near = fit_local_planes(values, weight, SIGMA_PX)
    known = weight > 0
    np.testing.assert_allclose(near[known], plane()[known], atol=1e-6)


def test_far_from_anything_known_values_stay():
    weight = np.zeros(SHAPE)
    weight[:, :10] = 1
    values = np.where(weight > 0, plane(), 7.0)
    assert np.all(fit_local_planes(values, weight, SIGMA_PX)[:, 40:] == 7.0)


def test_even_noise_shrinks_as_under_the_gaussian_itself():
    """White noise through a Gaussian of sigma s keeps 1 / (2 s √π) of its sd: even weights make the slopes decouple.

    3136 pixels in patches of 4 π s² = 41: 77 independent values, whose sd is known to 8 %; five of these.
    """
    noise = np.random.default_rng(2).standard_normal((80, 80))
    inner = slice(12, -12)
    kept = fit_local_planes(noise, np.ones((80, 80)), SIGMA_PX)[inner, inner].std()
    assert kept == pytest.approx(1 / (2 * SIGMA_PX * np.sqrt(np.pi)), rel=0.4)
