"""Gauss spheres against closed solutions, another optimiser, and the scatter of many fits."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from scipy.stats import binom, chi2

from greenough.instrument.errors import InputError
from greenough.pipeline.metrology.sphere import Sphere, _jacobian, fit_sphere, probing_error, spacing_error

CENTRE = np.array([1.2, -0.7, 3.0])


def cap(half_angle_deg: float, n: int, radius: float = 1.0) -> np.ndarray:
    """Points (n, 3) evenly over the cap around +z of a sphere at CENTRE (Fibonacci's spiral)."""
    z = 1 - (np.arange(n) + 0.5) / n * (1 - np.cos(np.radians(half_angle_deg)))
    azimuth = np.arange(n) * np.pi * (3 - np.sqrt(5))
    flat = np.sqrt(1 - z * z)
    return CENTRE + radius * np.column_stack([flat * np.cos(azimuth), flat * np.sin(azimuth), z])


def radial(points: np.ndarray) -> np.ndarray:
    return (points - CENTRE) / np.linalg.norm(points - CENTRE, axis=1)[:, None]


@pytest.mark.parametrize("half_angle_deg", [5, 45, 90, 180])
def test_points_on_a_sphere_give_it_and_their_cap(half_angle_deg):
    sphere = fit_sphere(cap(half_angle_deg, 400, 0.25))
    np.testing.assert_allclose(sphere.centre, CENTRE, atol=1e-9)
    assert sphere.diameter == pytest.approx(0.5, abs=1e-9)
    assert sphere.n == 400
    assert np.abs(sphere.residuals).max() < 1e-9
    if half_angle_deg < 180:
        assert sphere.cap_half_angle_deg == pytest.approx(half_angle_deg, rel=0.02)
    else:
        assert sphere.cap_half_angle_deg > 150


@pytest.mark.parametrize("half_angle_deg", [15, 60, 150])
def test_a_general_optimiser_finds_the_same_sphere(half_angle_deg):
    """MINPACK from the true sphere, by finite differences, on noisy points with unequal weights."""
    rng = np.random.default_rng(half_angle_deg)
    points = cap(half_angle_deg, 500)
    sigma = rng.uniform(0.5e-3, 2e-3, 500)
    points += sigma[:, None] * rng.standard_normal((500, 3))
    found = least_squares(
        lambda at: (np.linalg.norm(points - at[:3], axis=1) - at[3]) / sigma,
        np.append(CENTRE, 1.0), method="lm", xtol=1e-14, ftol=1e-14, gtol=1e-14, x_scale=1e-3,
    ).x  # fmt: skip
    sphere = fit_sphere(points, sigma)
    np.testing.assert_allclose(np.append(sphere.centre, sphere.radius), found, atol=1e-7)


def test_the_sum_of_squares_is_stationary():
    """Its gradient is that of a least-squares solution to 1e-9 mm in every parameter."""
    points = cap(40, 300) + 2e-3 * np.random.default_rng(5).standard_normal((300, 3))
    sphere = fit_sphere(points)
    offset = points - sphere.centre
    design = _jacobian(offset, np.linalg.norm(offset, axis=1))
    assert np.abs(np.linalg.solve(design.T @ design, design.T @ sphere.residuals)).max() < 2e-9


def test_derivatives_are_those_of_finite_differences():
    points, at, step = cap(70, 30), np.array([0.1, -0.2, 0.15, 0.9]), 1e-6

    def residual(parameters: np.ndarray) -> np.ndarray:
        return np.linalg.norm(points - CENTRE - parameters[:3], axis=1) - parameters[3]

    numeric = np.column_stack([(residual(at + d) - residual(at - d)) / (2 * step) for d in step * np.eye(4)])
    offset = points - CENTRE - at[:3]
    np.testing.assert_allclose(_jacobian(offset, np.linalg.norm(offset, axis=1)), numeric, atol=1e-9)


@pytest.mark.parametrize("half_angle_deg", [20, 30, 45, 60])
@pytest.mark.parametrize("radius", [None, 0.25])
def test_bias_and_scatter_of_many_fits_are_those_of_the_covariance(half_angle_deg, radius):
    """Points in a grid of 10 um on a ball of 0.5 mm, with noise in z alone, as a camera from above measures it.

    A z error moves a point along the radius by its cosine. Variances of 300 fits keep to chi2's limits and means to 4.5
    standard deviations, at a false-alarm rate of 1e-5 each, besides a bias of the second order in the noise, bounded by
    sigma times the sd over the sagitta, here taken as a tenth of an sd.
    """
    rng, fits, sigma_z = np.random.default_rng(half_angle_deg), 300, 0.3e-3
    reach = 0.25 * np.sin(np.radians(half_angle_deg))
    x, y = np.meshgrid(np.arange(-0.25, 0.25, 0.01), np.arange(-0.25, 0.25, 0.01))
    x, y = x[np.hypot(x, y) < reach], y[np.hypot(x, y) < reach]
    points = np.column_stack([x, y, np.sqrt(0.25**2 - x * x - y * y)])
    sigma = sigma_z * points[:, 2] / 0.25
    spheres = [
        fit_sphere(points + sigma_z * rng.standard_normal((len(x), 1)) * [0, 0, 1], sigma, radius) for _ in range(fits)
    ]
    found = np.array([np.append(s.centre, s.radius) for s in spheres])
    predicted = np.sqrt(np.diag(fit_sphere(points, sigma, radius).covariance))
    free = 4 if radius is None else 3
    assert np.all(found[:, free:] == 0.25)
    assert np.all(predicted[free:] == 0)
    true = np.array([0, 0, 0, 0.25])
    ratio = found[:, :free].var(axis=0, ddof=1) / predicted[:free] ** 2 * (fits - 1)
    low, high = chi2.ppf([0.5e-5, 1 - 0.5e-5], fits - 1)
    assert np.all((ratio > low) & (ratio < high))
    bias = (found.mean(axis=0) - true)[:free]
    assert np.all(np.abs(bias) < (4.5 / np.sqrt(fits) + 0.1) * predicted[:free])


def test_scatter_alone_gives_the_same_covariance_as_known_sigma():
    """Of 4000 points: the residuals' variance is that of the noise within 5 sd of a chi2 (1e-6)."""
    rng = np.random.default_rng(8)
    points = cap(60, 4000)
    points += 1e-3 * rng.standard_normal((4000, 1)) * radial(points)
    ratio = fit_sphere(points).covariance / fit_sphere(points, np.full(4000, 1e-3)).covariance
    assert np.ptp(ratio) < 1e-6
    assert abs(ratio[0, 0] - 1) < 5 * np.sqrt(2 / 3996)


def test_weights_let_bad_points_count_less():
    points = cap(60, 400)
    points[::2] += 5e-3 * radial(points)[::2]
    sigma = np.where(np.arange(400) % 2, 1e-6, 1.0)
    assert fit_sphere(points, sigma).radius == pytest.approx(1.0, abs=1e-9)
    assert fit_sphere(points).radius > 1.001


@settings(max_examples=40)
@given(
    turn=st.tuples(*[st.floats(-3, 3)] * 3), shift=st.tuples(*[st.floats(-50, 50)] * 3), scale=st.floats(0.1, 10),
    seed=st.integers(0, 2**32 - 1),
)  # fmt: skip
def test_the_sphere_moves_with_its_points_and_their_order_does_not_matter(turn, shift, scale, seed):
    rng = np.random.default_rng(seed)
    points = cap(70, 60) + 1e-3 * rng.standard_normal((60, 3))
    rotation = Rotation.from_rotvec(turn)
    one, moved = fit_sphere(points), fit_sphere(scale * rotation.apply(rng.permutation(points)) + shift)
    np.testing.assert_allclose(moved.centre, scale * rotation.apply(one.centre) + shift, atol=1e-6)
    assert moved.radius == pytest.approx(scale * one.radius, abs=1e-6)
    assert moved.cap_half_angle_deg == pytest.approx(one.cap_half_angle_deg, abs=1e-4)
    assert moved.diameter_sd == pytest.approx(scale * one.diameter_sd, rel=1e-4)


def test_probing_errors_of_a_dented_sphere_are_size_and_range():
    """A ball 4 um too big in diameter on the average, its points alternately 1 um out and in."""
    points = cap(180, 1000, 1.002)
    points += np.where(np.arange(1000) % 2, 1e-3, -1e-3)[:, None] * radial(points)
    error = probing_error(points, 2.0)
    assert error.size == pytest.approx(0.004, abs=1e-5)
    assert error.form.range_all == pytest.approx(0.002, rel=0.02)
    assert error.form.range_95 == pytest.approx(0.002, rel=0.02)
    assert (error.form.n, error.form.discarded) == (1000, 0)


def test_three_per_mille_may_go_and_are_counted():
    points = cap(120, 1000)
    points[[3, 500, 900]] += 0.1 * radial(points)[[3, 500, 900]]
    kept, all_of_them = probing_error(points, 2.0, discarded_share=0.003), probing_error(points, 2.0)
    assert all_of_them.form.range_all > 0.09
    assert kept.form.range_all < 1e-9
    assert (kept.form.n, kept.form.discarded) == (997, 3)
    with pytest.raises(InputError, match="VDI"):
        probing_error(points, 2.0, discarded_share=0.01)


def test_two_spheres_are_as_far_apart_as_their_centres_give_or_take_their_covariances():
    """The spacing's sd against 300 pairs of fits: chi2's limits at 1e-5."""
    rng, points = np.random.default_rng(11), cap(50, 300)
    noise = 1e-3 * radial(points)
    far = np.array([2.0, 1.0, -2.0])

    def sphere(shift: np.ndarray) -> Sphere:
        return fit_sphere(points + rng.standard_normal((300, 1)) * noise + shift, np.full(300, 1e-3))

    errors = [spacing_error(sphere(np.zeros(3)), sphere(far), 3.0) for _ in range(300)]
    values = np.array([error.error for error in errors])
    assert abs(values.mean()) < 4.5 * errors[0].sd / np.sqrt(300)
    low, high = chi2.ppf([0.5e-5, 1 - 0.5e-5], 299) / 299
    assert low < values.var(ddof=1) / errors[0].sd ** 2 < high
    assert errors[0].n == (300, 300)
    assert errors[0].distance == pytest.approx(errors[0].error + 3.0)


def test_a_noisy_plane_is_no_sphere():
    """Curvature beyond two of its standard deviations happens to 4.55 % of noisy planes: to 0 ... 14 of 100 (1e-4)."""
    rng, spheres = np.random.default_rng(2), 0
    for _ in range(100):
        try:
            fit_sphere(np.column_stack([rng.uniform(-1, 1, (400, 2)), 1e-3 * rng.standard_normal(400)]))
        except InputError:
            continue
        spheres += 1
    assert spheres <= binom.ppf(1 - 1e-4, 100, 0.0455)


@pytest.mark.parametrize(
    ("points", "told"),
    [
        (cap(60, 4), "at least 5"),
        (np.full((10, 3), np.nan), "finite"),
        (cap(60, 50) * [1, 1, 0], "do not determine"),
        (np.linspace(0, 1, 20)[:, None] * [1, 2, 3], "do not determine"),
        (np.ones((20, 3)), "do not determine"),
        (cap(60, 50)[:, :2], "shape"),
    ],
)
def test_points_that_make_no_sphere_are_told(points, told):
    with pytest.raises(InputError, match=told):
        fit_sphere(points)


def test_sigma_radius_and_certified_numbers_must_be_positive():
    points = cap(60, 50)
    for call, told in (
        (lambda: fit_sphere(points, np.zeros(50)), "positive"),
        (lambda: fit_sphere(points, np.ones(49)), "each of the 50"),
        (lambda: fit_sphere(points, radius=-1.0), "above 0"),
        (lambda: probing_error(points, 0.0), "above 0"),
        (lambda: spacing_error(fit_sphere(points), fit_sphere(points), 1.0), "above 0"),
    ):
        with pytest.raises(InputError, match=told):
            call()
