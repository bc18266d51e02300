"""Least-squares planes against closed solutions and the scatter of many."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from greenough.instrument.errors import InputError
from greenough.pipeline.metrology.flatness import fit_plane, flatness

NORMAL = np.array([0.2, -0.1, 1.0]) / np.linalg.norm([0.2, -0.1, 1.0])


def tilted(n_side: int = 20) -> np.ndarray:
    x, y = np.meshgrid(np.linspace(-3, 3, n_side), np.linspace(-2, 2, n_side))
    return np.column_stack([x.ravel(), y.ravel(), 5 - (NORMAL[0] * x + NORMAL[1] * y).ravel() / NORMAL[2]])


def test_points_on_a_tilted_plane_have_none():
    result = flatness(tilted())
    np.testing.assert_allclose(result.plane.normal, NORMAL, atol=1e-12)
    assert result.form.range_all < 1e-12
    np.testing.assert_allclose(result.plane.distances(tilted() + 0.1 * NORMAL), 0.1)


def test_levelled_points_keep_their_distances_and_lie_on_their_heights():
    rng = np.random.default_rng(3)
    plane, points = fit_plane(tilted()), rng.uniform(-1, 1, (6, 3))
    level = plane.levelled(points)
    np.testing.assert_allclose(level[:, 2], plane.distances(points), atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(level, axis=1), np.linalg.norm(points - plane.point, axis=1))
    axis = np.cross(NORMAL, [0, 0, 1])  # of the shortest turn: stays
    np.testing.assert_allclose(plane.levelled(plane.point + axis), axis, atol=1e-12)


def test_a_chequered_departure_is_its_own_flatness():
    """Alternately 1 um above and below, along the normal: no plane fits it better than the one without it."""
    sign = np.where(np.indices((20, 20)).sum(axis=0) % 2, 1.0, -1.0).ravel()
    result = flatness(tilted() + 1e-3 * sign[:, None] * NORMAL)
    assert result.form.range_all == pytest.approx(2e-3, rel=0.01)
    assert result.form.range_95 == pytest.approx(2e-3, rel=0.01)
    assert result.form.rms == pytest.approx(1e-3, rel=0.01)
    assert result.form.n == 400


def test_a_general_optimiser_finds_the_same_plane_with_weights():
    rng = np.random.default_rng(2)
    sigma = rng.uniform(0.01, 0.1, 400)
    points = tilted() + sigma[:, None] * rng.standard_normal((400, 1)) * NORMAL

    def cost(parameters: np.ndarray) -> float:
        normal = np.array([*parameters[:2], 1.0])
        distance = (points @ normal - parameters[2]) / np.linalg.norm(normal)
        return float(np.sum((distance / sigma) ** 2))

    found = minimize(cost, [0.2, -0.1, 5.0], method="Nelder-Mead", options={"xatol": 1e-9, "fatol": 1e-10}).x
    plane = fit_plane(points, sigma)
    np.testing.assert_allclose(plane.normal[:2] / plane.normal[2], found[:2], atol=1e-6)
    assert plane.point @ [*found[:2], 1.0] == pytest.approx(found[2], abs=1e-6)


def test_rms_and_95_percent_are_those_of_the_noise():
    """Gaussian noise on 10000 points: rms 1 and 95 % range 3.92, within 5 sd of either."""
    points = tilted(100)
    form = flatness(points + 1e-3 * np.random.default_rng(7).standard_normal((10_000, 1)) * NORMAL).form
    assert abs(1e3 * form.rms - 1) < 5 / np.sqrt(2 * 10_000)
    density = np.exp(-(1.959964**2) / 2) / np.sqrt(2 * np.pi)
    assert abs(1e3 * form.range_95 - 3.919928) < 5 * np.sqrt(2 * 0.025 * 0.95 / 10_000) / density
    assert 6.5 < 1e3 * form.range_all < 11


@settings(max_examples=40)
@given(
    turn=st.tuples(*[st.floats(-3, 3)] * 3), shift=st.tuples(*[st.floats(-50, 50)] * 3), scale=st.floats(0.1, 10),
    seed=st.integers(0, 2**32 - 1),
)  # fmt: skip
def test_flatness_is_the_same_in_every_position_and_order_and_grows_with_scale(turn, shift, scale, seed):
    rng = np.random.default_rng(seed)
    points = tilted() + 1e-2 * rng.standard_normal((400, 3))
    moved = scale * Rotation.from_rotvec(turn).apply(rng.permutation(points)) + shift
    one, other = flatness(points).form, flatness(moved).form
    for name in ("range_all", "range_95", "rms"):
        assert getattr(other, name) == pytest.approx(scale * getattr(one, name), rel=1e-7)


def test_three_per_mille_may_go_and_are_counted():
    points = tilted(20)
    points[37, 2] += 1.0
    assert flatness(points).form.range_all > 0.9
    form = flatness(points, discarded_share=0.003).form
    assert form.range_all < 1e-12
    assert (form.n, form.discarded) == (399, 1)


@pytest.mark.parametrize(
    ("points", "sigma", "told"),
    [
        (tilted()[:3], None, "at least 4"),
        (np.full((9, 3), np.nan), None, "finite"),
        (np.linspace(0, 1, 20)[:, None] * [1, 2, 3], None, "one line"),
        (np.ones((9, 3)), None, "one line"),
        (tilted(3), np.zeros(9), "positive"),
    ],
)
def test_points_that_make_no_plane_are_told(points, sigma, told):
    with pytest.raises(InputError, match=told):
        fit_plane(points, sigma)
