"""Claims about the diaphragm."""

import numpy as np
import pytest

from greenough.scenes.diaphragm import DEFLECTION_MM, diaphragm, surface

STATES = list(DEFLECTION_MM)


def polar(vertices):
    return np.hypot(vertices[..., 0], vertices[..., 1]), np.arctan2(vertices[..., 1], vertices[..., 0])


def test_the_three_states_together_nearly_fill_the_range():
    z = {state: diaphragm(state).parts[0].vertices[:, 2] for state in STATES}
    low, high = min(each.min() for each in z.values()), max(each.max() for each in z.values())
    assert low > -1.4
    assert high < 1.4
    assert high - low > 2.7
    middle = {state: each[0] for state, each in z.items()}  # the first vertex is the centre
    assert middle["concave"] < middle["equilibrated"] < middle["raised"]


@pytest.mark.parametrize("state", STATES)
def test_it_is_clamped_flat_and_covers_the_lit_height(state):
    vertices = diaphragm(state).parts[0].vertices
    r, _ = polar(vertices)
    np.testing.assert_allclose(vertices[r >= 3.4, 2], 0, atol=1e-15)
    assert 2 * r.max() > 6.1


@pytest.mark.parametrize("state", STATES)
def test_facets_depart_from_the_surface_by_less_than_a_tenth_of_a_micrometre(state):
    part = diaphragm(state).parts[0]
    corners = part.vertices[part.faces]
    for weights in np.vstack([(1 - np.eye(3)) / 2, np.full((1, 3), 1 / 3)]):
        point = np.einsum("mcx,c->mx", corners, weights)
        z, _, _ = surface(*polar(point), DEFLECTION_MM[state])
        assert np.abs(z - point[:, 2]).max() < 1e-4


@pytest.mark.parametrize("state", STATES)
def test_the_derivatives_are_those_of_the_heights(state):
    rng = np.random.default_rng(0)
    r, azimuth = rng.uniform(0.01, 3.7, 5000), rng.uniform(-np.pi, np.pi, 5000)
    w, d = DEFLECTION_MM[state], 1e-6
    _, by_radius, by_azimuth = surface(r, azimuth, w)
    np.testing.assert_allclose(
        by_radius, (surface(r + d, azimuth, w)[0] - surface(r - d, azimuth, w)[0]) / (2 * d), atol=1e-5
    )
    np.testing.assert_allclose(
        by_azimuth, (surface(r, azimuth + d, w)[0] - surface(r, azimuth - d, w)[0]) / (2 * d), atol=1e-5
    )


def test_grooves_are_as_deep_and_as_many_as_the_drawing_says():
    specimen = diaphragm("equilibrated")
    azimuth = np.linspace(0, 2 * np.pi, 36001)
    z, _, _ = surface(np.full_like(azimuth, 2.3), azimuth, DEFLECTION_MM["equilibrated"])
    np.testing.assert_allclose(np.ptp(z), specimen.nominal["radial_groove_depth_mm"], rtol=1e-4)
    spectrum = np.abs(np.fft.rfft(z[:-1] - z[:-1].mean()))
    assert np.argmax(spectrum) == specimen.nominal["radial_groove_count"]
    flat, _, _ = surface(np.array([0.9, 1.2, 1.5]), np.zeros(3), 0.0)
    np.testing.assert_allclose(flat, [0, -specimen.nominal["concentric_groove_depth_mm"], 0], atol=1e-15)
