"""What blur does to spots and phases of a tilted surface, against rays through open stops."""

import cv2
import numpy as np
import pytest

from greenough.pipeline.bundle_data import SpotPhases
from greenough.pipeline.point_spread import PointSpread
from greenough.pipeline.slope_blur import freed_from_blur
from greenough.pipeline.spot_fit import fit_spots
from greenough.pipeline.spots import Spots

PX_PER_MM = 50.0
NA = 0.015
RAYS = 400
SHAPE = (481, 641)
MIDDLE = np.array([320.0, 240.0])


def spread(*focus_mm: float) -> PointSpread:
    return PointSpread(0.3, NA * PX_PER_MM, focus_mm, SHAPE)


def stop() -> np.ndarray:
    """Angles (rays, 2) that fill a round stop evenly."""
    k = np.arange(RAYS) + 0.5
    radius, angle = NA * np.sqrt(k / RAYS), np.pi * (1 + 5**0.5) * k
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=-1)


def plain(pixels: np.ndarray) -> Spots:
    return Spots(pixels, np.ones_like(pixels), np.ones(len(pixels)))


def flat(pixels: np.ndarray, gradient: tuple[float, float] = (1.0, 0.0)) -> SpotPhases:
    n = len(pixels)
    return SpotPhases(np.zeros(n), np.tile(gradient, (n, 1)), np.ones(n))


def seen_phase(at: np.ndarray, rise: np.ndarray, density: float) -> float:
    """Phase of the plane z = rise · xy at a pixel that looks at the place ``at`` (2,) mm of the level plane in focus.

    The fringes stand upright and are ``density`` rad/mm; both stops are open. Every ray is met with the plane, and the
    phasors are added up.
    """
    angles = stop()
    height = (at @ rise) / (1 - angles @ rise)
    places = at + height[:, None] * angles  # (camera's rays, 2)
    mirrors = places[:, None, 0] - height[:, None] * angles[:, 0]  # (camera's, projector's)
    light = 1 - angles @ rise
    return float(np.angle(np.mean(light * np.exp(1j * density * (mirrors - at[0])))) + density * at[0])


@pytest.mark.parametrize("rise", [(0.4, 0.0), (-0.3, 0.2), (0.0, 0.4)])
def test_phases_of_a_blurred_slope_are_levelled(rise):
    """To a fifth of what they are moved: the next orders in the slope, and how evenly the rays fill the stops."""
    density, rise = 2 * np.pi / 0.2, np.array(rise)
    u, v = np.meshgrid(np.linspace(-150, 150, 5), np.linspace(-100, 100, 5))
    offset = np.stack([u.ravel(), v.ravel()], axis=-1)
    blurred = np.array([seen_phase(at, rise, density) for at in offset / PX_PER_MM])
    gradient = np.tile([density / PX_PER_MM, 0.0], (len(offset), 1))
    z = offset / PX_PER_MM @ rise
    phases = SpotPhases(blurred, gradient, np.ones(len(offset)))
    _, freed = freed_from_blur(plain(MIDDLE + offset), phases, z, spread(0.0, 0.0, 0.0, 0.0))
    left = freed.phase_rad - density * offset[:, 0] / PX_PER_MM
    largest = NA**2 / 2 * np.abs(z).max() * np.hypot(*rise) * density
    assert np.abs(left).max() <= 0.2 * largest


def test_phases_of_level_surfaces_stay():
    pixels = MIDDLE + np.array([[0.0, 0.0], [100.0, 0.0], [0.0, 100.0]])
    _, freed = freed_from_blur(plain(pixels), flat(pixels), np.full(3, 1.2), spread(0.2, 1e-3, 0.0, 1e-6))
    np.testing.assert_allclose(freed.phase_rad, 0.0, atol=1e-12)


def test_the_focus_of_both_paths_leans_either_way():
    """A lean of the camera's focus along the columns is not in the phases; its height and curvature are."""
    pixels = MIDDLE + np.array([[100.0, 0.0], [0.0, 100.0], [-100.0, 0.0]])
    z = 0.007 * (pixels[:, 0] - MIDDLE[0])

    def phase(*focus_mm: float) -> np.ndarray:
        return freed_from_blur(plain(pixels), flat(pixels), z, spread(*focus_mm))[1].phase_rad

    np.testing.assert_allclose(phase(0.0, 2e-3, 0.0, 0.0), phase(0.0, 0.0, 0.0, 0.0), atol=1e-15)
    moved = (NA * PX_PER_MM) ** 2 / 2 * 0.007
    np.testing.assert_allclose(phase(0.3, 0.0, 0.0, 0.0) - phase(0.0, 0.0, 0.0, 0.0), 0.3 * moved, rtol=1e-9)


def blurred_disc(radius: float, rise: float, height: float) -> np.ndarray:
    """A spot at `MIDDLE` on a board that rises along u, (side, side), through an open stop; px and mm per px.

    Every ray of a pixel is met with the board; diffraction and pixel are a Gaussian of 0.7 px.
    """
    fine, side = 5, 49
    t = (np.arange(side * fine) + 0.5) / fine - side / 2
    u, v = np.meshgrid(t, t)
    picture = np.zeros(u.shape)
    half = stop()[::8] * PX_PER_MM  # px per mm
    for a in (rays := np.concatenate([half, -half])):
        h = (height + rise * u) / (1 - a[0] * rise)
        picture += np.clip((radius - np.hypot(u + a[0] * h, v + a[1] * h)) * fine + 0.5, 0, 1)
    picture = cv2.GaussianBlur(picture / len(rays), (0, 0), 0.7 * fine)
    return 20 + 100 * picture.reshape(side, fine, side, fine).mean(axis=(1, 3))


@pytest.mark.parametrize("radius", [4.4, 8.8, 14.0])
def test_spots_are_where_the_middle_rays_have_them(radius):
    """The fit alone is pulled by up to twice δ; what is left is of higher order, or how pictures are sampled."""
    rise, height = 0.008, 1.5
    unit = (NA * PX_PER_MM) ** 2 / 4 * height * rise
    fit = fit_spots(blurred_disc(radius, rise, height), np.array([[24.0, 24.0]]), np.full((1, 2), radius))
    pulled = fit.centres_px[0] - 24.0
    assert abs(pulled[0]) > 0.25 * unit
    # Three places of the same spot: a plane needs as many.
    place = np.array([[0.0, 0.0], [50.0, 0.0], [0.0, 50.0]])
    shape = np.repeat(fit.axes_px, 3, axis=0)
    spots = Spots(MIDDLE + place + pulled, shape, np.ones(3), np.repeat(fit.blur_px, 3), np.repeat(fit.blur_pull, 3))
    z = height + rise * place[:, 0]
    phases = flat(place)
    freed, phase = freed_from_blur(spots, phases, z, spread(0.0, 0.0, 0.0, 0.0))
    np.testing.assert_allclose(freed.centres_px[0], MIDDLE, atol=0.3 * unit)
    # The phase has moved along with the centre, besides what it was itself.
    np.testing.assert_allclose(phase.phase_rad[0], (freed.centres_px - spots.centres_px)[0, 0] - 2 * unit, rtol=1e-6)


def test_spots_that_were_not_seen_do_not_matter():
    pixels = MIDDLE + np.array([[0.0, 0.0], [100.0, 0.0], [0.0, 100.0], [80.0, 70.0]])
    z = 0.01 * (pixels[:, 0] - MIDDLE[0]) + 0.3
    point_spread = spread(0.0, 0.0, 0.0, 0.0)
    _, all_seen = freed_from_blur(plain(pixels), flat(pixels), z, point_spread)
    pixels[3] = np.nan
    _, without = freed_from_blur(plain(pixels), flat(pixels), z, point_spread)
    np.testing.assert_allclose(without.phase_rad[:3], all_seen.phase_rad[:3], atol=1e-12)
    _, too_few = freed_from_blur(plain(np.full((4, 2), np.nan)), flat(pixels), z, point_spread)
    np.testing.assert_array_equal(too_few.phase_rad, 0.0)
