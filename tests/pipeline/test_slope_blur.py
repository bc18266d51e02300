"""What blur does to the phase of a tilted surface, against rays through open stops."""

import numpy as np
import pytest

from greenough.pipeline.bundle_data import SpotPhases
from greenough.pipeline.point_spread import PointSpread
from greenough.pipeline.slope_blur import displacement_px, level_phases
from greenough.pipeline.spots import Spots

PX_PER_MM = 50.0
NA = 0.015
RAYS = 400
SPREAD = PointSpread(0.3, NA * PX_PER_MM, (0.2, 0.0, 0.0, 0.0), (480, 640))


def disc() -> np.ndarray:
    """Angles (rays, 2) that fill a round stop evenly."""
    k = np.arange(RAYS) + 0.5
    radius, angle = NA * np.sqrt(k / RAYS), np.pi * (1 + 5**0.5) * k
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=-1)


def seen(pixels: np.ndarray, rise: np.ndarray, density: float) -> np.ndarray:
    """Phase (n,) of a plane z = rise · xy under both open stops, which look down from above; xy = 0 is pixel 0.

    The fringes stand upright and are ``density`` rad/mm. Every ray is met with the plane, and the phasors are added up.
    """
    focus, stop = SPREAD.focus_mm[0], disc()
    result = np.empty(len(pixels))
    for k, at in enumerate(pixels / PX_PER_MM):  # in the plane of focus
        t = (at @ rise - focus) / (1 - stop @ rise)
        places = at + t[:, None] * stop  # (camera's rays, 2)
        height = places @ rise - focus
        mirrors = places[:, None, 0] - height[:, None] * stop[:, 0]  # (camera's, projector's)
        light = 1 - stop @ rise
        result[k] = np.angle(np.mean(light * np.exp(1j * density * (mirrors - at[0])))) + density * at[0]
    return result


@pytest.mark.parametrize("rise", [(0.4, 0.0), (-0.3, 0.2), (0.0, 0.4), (0.0, 0.0)])
def test_phases_of_a_blurred_slope_are_levelled(rise):
    """To a tenth of what it may be: the next orders in the slope, and how evenly the rays fill the stops."""
    density = 2 * np.pi / 0.2
    u, v = np.meshgrid(np.linspace(-150, 150, 5), np.linspace(-100, 100, 5))
    pixels = np.stack([u.ravel(), v.ravel()], axis=-1)
    z = pixels / PX_PER_MM @ np.array(rise)
    blurred = seen(pixels, np.array(rise), density)
    gradient = np.tile([density / PX_PER_MM, 0.0], (len(pixels), 1))
    spots = Spots(pixels, np.ones_like(pixels), np.ones(len(pixels)))
    phases = SpotPhases(blurred, gradient, np.ones(len(pixels)))
    (levelled,) = level_phases([phases], [spots], z[None], SPREAD)
    left = levelled.phase_rad - density * pixels[:, 0] / PX_PER_MM
    largest = NA**2 / 2 * np.abs(z - SPREAD.focus_mm[0]).max() * np.hypot(*rise) * density
    assert np.abs(left).max() <= 0.1 * largest + 1e-7


def test_without_a_point_spread_phases_stay():
    pixels = np.array([[0.0, 0.0], [100.0, 0.0], [0.0, 100.0]])
    phases = SpotPhases(np.arange(3.0), np.ones((3, 2)), np.ones(3))
    spots = Spots(pixels, np.ones((3, 2)), np.ones(3))
    assert level_phases([phases], [spots], np.arange(3.0)[None], None) == (phases,)


def test_spots_that_were_not_seen_do_not_matter():
    pixels = np.array([[0.0, 0.0], [100.0, 0.0], [0.0, 100.0], [80.0, 70.0]])
    z = 0.01 * pixels[:, 0] + 0.3
    all_seen = displacement_px(pixels, z, SPREAD)
    pixels[3] = np.nan
    np.testing.assert_allclose(displacement_px(pixels, z, SPREAD)[:3], all_seen[:3], atol=1e-12)
    too_few = np.full((4, 2), np.nan)
    np.testing.assert_array_equal(displacement_px(too_few, z, SPREAD), 0.0)


def test_where_a_tilted_plane_is_in_focus_nothing_moves():
    pixels = np.array([[320.0, 240.0], [420.0, 240.0], [320.0, 340.0]])
    z = SPREAD.focus_mm[0] + 0.01 * (pixels[:, 0] - 320)
    np.testing.assert_allclose(displacement_px(pixels, z, SPREAD)[[0, 2]], 0.0, atol=1e-12)
    assert displacement_px(pixels, z, SPREAD)[1, 0] > 1e-3
