"""The textbook's shading against what any shading must obey."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from greenough.scenes.materials import MATERIALS, RoughConductor
from greenough.twin.validation.shading import fresnel, ggx, masking, mean_fresnel, radiance

UP = np.array([0.0, 0.0, 1.0])


def direction(polar: float, azimuth: float) -> np.ndarray:
    return np.array([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)])


def hemisphere(n: int = 400) -> tuple[np.ndarray, np.ndarray]:
    """Directions (n, n, 3) and their solid angles (n, n): the midpoint rule over cosine and azimuth."""
    cosine, azimuth = (np.arange(n) + 0.5) / n, (np.arange(n) + 0.5) / n * 2 * np.pi
    sine = np.sqrt(1 - cosine**2)[:, None]
    axes = [sine * np.cos(azimuth), sine * np.sin(azimuth), cosine[:, None] * np.ones(n)]
    return np.stack(axes, axis=-1), np.full((n, n), 2 * np.pi / n**2)


@pytest.mark.parametrize("alpha", [0.2, 0.25, 0.5])
def test_microfacets_cover_the_surface_once(alpha):
    facets, solid_angle = hemisphere()
    assert (ggx(facets[..., 2], alpha) * facets[..., 2] * solid_angle).sum() == pytest.approx(1, abs=2e-3)


@pytest.mark.parametrize("alpha", [0.2, 0.5])
@pytest.mark.parametrize("cosine", [1.0, 0.8, 0.4])
def test_the_facets_that_a_direction_sees_fill_what_it_sees_of_the_surface(alpha, cosine):
    """Smith's condition: integral of D G1 <v, m> over the facets m that face v is the cosine of v."""
    facets, solid_angle = hemisphere(800)
    eye = direction(np.arccos(cosine), 0.3)
    facing = np.clip(facets @ eye, 0, None)
    seen = (ggx(facets[..., 2], alpha) * masking(np.array(cosine), alpha) * facing * solid_angle).sum()
    assert seen == pytest.approx(cosine, abs=3e-3)


@given(
    st.sampled_from(sorted(MATERIALS)),
    st.floats(0, 1.4),
    st.floats(0, 1.4),
    st.floats(0, 2 * np.pi),
)
def test_light_and_eye_may_be_exchanged(name, light_polar, eye_polar, azimuth):
    light, eye = direction(light_polar, 0.0), direction(eye_polar, azimuth)
    there = radiance(MATERIALS[name], UP, light, eye) / light[2]
    back = radiance(MATERIALS[name], UP, eye, light) / eye[2]
    np.testing.assert_allclose(there, back, rtol=1e-9)


@pytest.mark.parametrize("name", sorted(MATERIALS))
@pytest.mark.parametrize("polar", [0.0, 0.6, 1.1])
def test_no_surface_reflects_more_than_it_gets(name, polar):
    eyes, solid_angle = hemisphere()
    light = np.broadcast_to(direction(polar, 1.0), eyes.shape)
    out = radiance(MATERIALS[name], np.broadcast_to(UP, eyes.shape), light, eyes)
    share = (out * eyes[..., 2] * solid_angle).sum() / np.cos(polar)
    assert 0.05 < share < MATERIALS[name].reflectance + 0.2  # the plastic's coat reflects, too
    assert share < 1


def test_a_perfect_conductor_loses_only_what_facets_shade():
    eyes, solid_angle = hemisphere()
    mirror = RoughConductor(alpha=0.1, reflectance=1.0)
    out = radiance(mirror, np.broadcast_to(UP, eyes.shape), np.broadcast_to(UP, eyes.shape), eyes)
    assert 0.97 < (out * eyes[..., 2] * solid_angle).sum() < 1


def test_behind_the_surface_there_is_no_light():
    below = direction(2.0, 0.0)
    for material in MATERIALS.values():
        assert radiance(material, UP, below, UP) == 0
        assert radiance(material, UP, UP, below) == 0


def test_fresnels_reflectance_of_glass():
    assert fresnel(np.array(1.0), 1.5) == pytest.approx(0.04)
    assert fresnel(np.array(1e-9), 1.5) == pytest.approx(1)
    # At Brewster's angle only half of the light, that polarised across, is reflected.
    brewster = np.cos(np.arctan(1.5))
    assert fresnel(brewster, 1.5) == pytest.approx(((1 - 1.5**2) / (1 + 1.5**2)) ** 2 / 2)
    assert mean_fresnel(1.5) == pytest.approx(0.0918, abs=1e-4)  # Walsh's formula
