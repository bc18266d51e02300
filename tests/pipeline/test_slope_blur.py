"""What blur does to spots and phases of a tilted surface, against rays through open stops and computed pictures."""

import numpy as np
import pytest
from scipy.signal import fftconvolve
from scipy.special import j1

from greenough.pipeline.bundle_data import SpotPhases, measure_spot_phases
from greenough.pipeline.decode import PhaseMap
from greenough.pipeline.point_spread import PointSpread
from greenough.pipeline.slope_blur import freed_from_blur
from greenough.pipeline.spot_fit import fit_spots
from greenough.pipeline.spots import Spots

PX_PER_MM = 101.0
NA = 0.015
D = NA * PX_PER_MM
RAYS = 400
SHAPE = (481, 641)
MIDDLE = np.array([320.0, 240.0])
DENSITY = 2 * np.pi / 0.214  # rad/mm
AIRY_PX = 2.2  # to the first dark ring
INK = 0.1
FINE = 4  # subpixels along a pixel


def spread(height: float, along_u: float, along_v: float, curvature: float) -> PointSpread:
    return PointSpread(0.56, D, (height, along_u, along_v, curvature), SHAPE)


def stop(rays: int = RAYS) -> np.ndarray:
    """Angles (rays, 2) that fill a round stop evenly, in units of NA."""
    k = np.arange(rays // 2) + 0.5
    radius, angle = np.sqrt(2 * k / rays), np.pi * (1 + 5**0.5) * k
    half = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=-1)
    return np.concatenate([half, -half])


def plain(pixels: np.ndarray) -> Spots:
    return Spots(pixels, np.ones_like(pixels), np.ones(len(pixels)))


def flat(pixels: np.ndarray, gradient: tuple[float, float] = (1.0, 0.0)) -> SpotPhases:
    n = len(pixels)
    return SpotPhases(np.zeros(n), np.tile(gradient, (n, 1)), np.ones(n))


def levelled(spots: Spots, phases: SpotPhases, z: np.ndarray, point_spread: PointSpread, **shares: float) -> np.ndarray:
    """Freed phases (n,), carried back to where the spots were."""
    freed, levelled = freed_from_blur(spots, phases, z, point_spread, **shares)
    return levelled.phase_rad - np.sum(phases.gradient_rad * (freed.centres_px - spots.centres_px), axis=1)


def seen_phase(at: np.ndarray, rise: np.ndarray) -> float:
    """Phase of the plane z = rise · xy at a pixel that looks at the place ``at`` (2,) mm of the level plane in focus.

    The fringes stand upright; both stops are open. Every ray is met with the plane, and the phasors are added up.
    """
    angles = NA * stop()
    height = (at @ rise) / (1 - angles @ rise)
    places = at + height[:, None] * angles  # (camera's rays, 2)
    mirrors = places[:, None, 0] - height[:, None] * angles[:, 0]  # (camera's, projector's)
    light = 1 - angles @ rise
    return float(np.angle(np.mean(light * np.exp(1j * DENSITY * (mirrors - at[0])))) + DENSITY * at[0])


@pytest.mark.parametrize("rise", [(0.4, 0.0), (-0.3, 0.2), (0.0, 0.4)])
def test_phases_of_places_on_a_blurred_slope_are_levelled(rise):
    """To a fifth of what they are moved: the next orders in the slope, and how evenly the rays fill the stops."""
    rise = np.array(rise)
    u, v = np.meshgrid(np.linspace(-150, 150, 5), np.linspace(-100, 100, 5))
    offset = np.stack([u.ravel(), v.ravel()], axis=-1)
    blurred = np.array([seen_phase(at, rise) for at in offset / PX_PER_MM])
    gradient = np.tile([DENSITY / PX_PER_MM, 0.0], (len(offset), 1))
    z = offset / PX_PER_MM @ rise
    phases = SpotPhases(blurred, gradient, np.ones(len(offset)))
    freed = levelled(plain(MIDDLE + offset), phases, z, spread(0.0, 0.0, 0.0, 0.0), fit_pull=0.0, rim_share=0.0)
    left = freed - DENSITY * offset[:, 0] / PX_PER_MM
    largest = NA**2 / 2 * np.abs(z).max() * np.hypot(*rise) * DENSITY
    assert np.abs(left).max() <= 0.2 * largest


def test_phases_of_level_surfaces_stay():
    pixels = MIDDLE + np.array([[0.0, 0.0], [100.0, 0.0], [0.0, 100.0]])
    freed = levelled(plain(pixels), flat(pixels), np.full(3, 1.2), spread(0.2, 1e-3, 0.0, 1e-6), rim_share=0.0)
    np.testing.assert_allclose(freed, 0.0, atol=1e-12)


def test_the_focus_of_both_paths_leans_either_way():
    """A lean of the camera's focus along the columns is not in the phases; its height and curvature are."""
    pixels = MIDDLE + np.array([[100.0, 0.0], [0.0, 100.0], [-100.0, 0.0]])
    z = 0.007 * (pixels[:, 0] - MIDDLE[0])

    def phase(height: float, lean: float) -> np.ndarray:
        return levelled(plain(pixels), flat(pixels), z, spread(height, lean, 0.0, 0.0), rim_share=0.0)

    np.testing.assert_allclose(phase(0.0, 2e-3), phase(0.0, 0.0), atol=1e-15)
    np.testing.assert_allclose(phase(0.3, 0.0) - phase(0.0, 0.0), 0.3 * D**2 / 2 * 0.007, rtol=1e-9)


def picture(radius: float, rise: float, lean: float, height: float, coma: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """A spot in the middle of a board, as phasors and as light, (side, side) each; px and mm per px.

    The board rises along u by ``rise``, the surface in focus by ``lean``. Every ray of a pixel is met with the board,
    off by a coma that does not move the mean; diffraction is an Airy pattern. Fringes are carried along u.
    """
    side = 2 * int(radius + 16)
    t = (np.arange(side * FINE) + 0.5) / FINE - side / 2
    u, v = np.meshgrid(t, t)
    phasors, light = np.zeros(u.shape, complex), np.zeros(u.shape)
    rays = stop(160)
    for a, b in rays:
        h = (height + (rise - lean) * u) / (1 - D * a * rise)
        x, y = u + D * a * h + coma * (3 * a * a + b * b - 1), v + D * b * h
        reflected = INK + (1 - INK) * np.clip((radius - np.hypot(x, y)) * FINE + 0.5, 0, 1)
        light += reflected
        phasors += reflected * np.exp(1j * DENSITY / PX_PER_MM * x)
    reach = np.arange(-20 * FINE, 20 * FINE + 1) / FINE
    r = np.maximum(3.8317 / AIRY_PX * np.hypot(*np.meshgrid(reach, reach)), 1e-9)
    airy = (2 * j1(r) / r) ** 2
    airy /= airy.sum() * len(rays)
    edge = INK * len(rays)  # of an endless board of ink

    def pixels(values: np.ndarray) -> np.ndarray:
        return fftconvolve(values, airy, "same").reshape(side, FINE, side, FINE).mean(axis=(1, 3))

    return pixels(phasors), pixels(light - edge) + INK


def freed_spot(radius: float, rise: float, lean: float, height: float, coma: float = 0.0) -> tuple[float, float]:
    """Errors along u of a spot's centre, and of its phase by the camera's blur in px, in units of D²/4 height slope."""
    phasors, light = picture(radius, rise, lean, height, coma)
    side = len(light)
    middle = np.full((1, 2), side / 2 - 0.5)
    fit = fit_spots(100 * light, middle, np.full((1, 2), radius), np.zeros((1, 2)))
    carrier = DENSITY / PX_PER_MM * (np.arange(side) - middle[0, 0])
    absolute = (carrier + np.angle(phasors * np.exp(-1j * carrier))).astype(np.float32)
    ones = np.ones_like(absolute)
    phase_map = PhaseMap(absolute, ones, ones, ones > 0, ones, ones)
    found = Spots(fit.centres_px, fit.axes_px, fit.sigma_px)
    phases = measure_spot_phases(phase_map, found)
    # Three places of the same spot: a plane needs as many.
    place = np.array([[0.0, 0.0], [50.0, 0.0], [0.0, 50.0]])
    here = MIDDLE + fit.centres_px - middle
    thrice = Spots(here + place, np.repeat(fit.axes_px, 3, axis=0), np.repeat(fit.sigma_px, 3))
    thrice_phases = SpotPhases(*(np.repeat(each, 3, axis=0) for each in vars(phases).values()))
    # The surface in focus goes through z = 0 at the spot, and the projector's is level where the camera's is.
    spots, levels = freed_from_blur(thrice, thrice_phases, height + rise * place[:, 0], spread(0.0, lean, 0.0, 0.0))
    unit = D**2 / 4 * height * (rise or lean)
    of_projector = D**2 / 4 * height * rise
    gradient = phases.gradient_rad[0, 0]
    along = spots.centres_px[0, 0] - MIDDLE[0]
    return along / unit, (levels.phase_rad[0] / gradient - along + of_projector) / unit


@pytest.mark.parametrize("radius", [8.8, 20.0])
@pytest.mark.parametrize(("rise", "lean"), [(0.0034, 0.0), (0.0, 0.0034)])
@pytest.mark.parametrize("height", [0.75, 1.5])
def test_spots_and_phases_are_where_rays_have_them(radius, rise, lean, height):
    """To a third of the unit in which they are moved by 1 to 2; higher orders are left, more in a big spot."""
    centre, phase = freed_spot(radius, rise, lean, height)
    assert abs(centre) < 0.35
    assert abs(phase) < 0.15


def test_coma_changes_little_of_it():
    for sign in (1, -1):
        skewed = [freed_spot(8.8, each, 0.0, 1.5, coma=0.3 * sign)[0] * each for each in (0.0034, -0.0034)]
        assert abs(skewed[0] - skewed[1]) / 2 < 0.3 * 0.0034


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
