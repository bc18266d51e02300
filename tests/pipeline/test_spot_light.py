"""Claims about the light's gradient at spots, as their neighbours tell it."""

import numpy as np
import pytest
from scipy.special import ndtr

from greenough.pipeline.spot_fit import fit_spots
from greenough.pipeline.spot_light import light_gradients

SHAPE = (480, 640)
PITCH, RADIUS = 60.0, 9.0
NOISE = 0.5


def centres() -> np.ndarray:
    u, v = np.meshgrid(np.arange(40, 620, PITCH), np.arange(30, 470, PITCH))
    return np.stack([u.ravel(), v.ravel()], axis=-1)


def light(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    x, y = (u - 300) / 320, (v - 250) / 320
    return np.exp(-0.3 * x**2 - 0.2 * y**2 + 0.1 * x * y**2 + 0.05 * x)


def true_gradients() -> np.ndarray:
    at, step = centres(), 0.5
    along_u = np.log(light(at[:, 0] + step, at[:, 1]) / light(at[:, 0] - step, at[:, 1]))
    along_v = np.log(light(at[:, 0], at[:, 1] + step) / light(at[:, 0], at[:, 1] - step))
    return np.stack([along_u, along_v], axis=-1)


def painted(rng: np.random.Generator, noise: float = NOISE, blur_px: float = 1.2) -> np.ndarray:
    """Spots in a light that falls off, on ink of a tenth."""
    v, u = np.indices(SHAPE)
    white = sum(ndtr((RADIUS - np.hypot(u - x, v - y)) / blur_px) for x, y in centres())
    return 100 * light(u, v) * (0.1 + 0.9 * white) + noise * rng.standard_normal(SHAPE)


def axes(n: int) -> np.ndarray:
    return np.full((n, 2), RADIUS)


def found(image: np.ndarray) -> np.ndarray:
    gradients = light_gradients(image, centres(), axes(len(centres())))
    assert gradients is not None
    return gradients


def test_gradients_are_those_of_the_light():
    """Largest gradient 1.9e-3 per px; brightness over some 30 pixels is known to 1e-3 of it."""
    error = found(painted(np.random.default_rng(1))) - true_gradients()
    assert np.sqrt(np.mean(error**2)) < 2e-5
    assert np.abs(error).max() < 1e-4


def test_a_stain_counts_for_nothing():
    image = painted(np.random.default_rng(2))
    x, y = centres()[33].astype(int)
    clean = found(image)
    image[y - 12 : y + 13, x - 12 : x + 13] *= 0.8
    assert np.abs(found(image) - clean).max() < 5e-5


def test_too_few_spots_tell_nothing():
    assert light_gradients(painted(np.random.default_rng(3)), centres()[:13], axes(13)) is None


@pytest.mark.parametrize("rows", [3, 5])
def test_few_spots_tell_the_coarse_course(rows):
    """Within a fifth of the largest gradient there is, where a polynomial of degree 4 would have too few of them."""
    n = rows * 10
    gradients = light_gradients(painted(np.random.default_rng(7)), centres()[:n], axes(n))
    assert gradients is not None
    assert np.abs(gradients - true_gradients()[:n]).max() < 4e-4


def test_failed_fits_have_no_gradient_and_do_no_harm():
    image, at = painted(np.random.default_rng(4)), centres()
    whole = found(image)
    at[5] = np.nan
    some = light_gradients(image, at, np.where(np.isnan(at), np.nan, axes(len(at))))
    assert some is not None
    assert np.isnan(some[5]).all()
    assert np.abs(np.delete(some - whole, 5, axis=0)).max() < 5e-5


def test_a_known_light_makes_centres_more_exact():
    """Mean and scatter of the errors, over 80 spots and two coordinates."""
    image = painted(np.random.default_rng(5), noise=2.0)
    own, known = (fit_spots(image, centres(), axes(80), given).centres_px - centres() for given in (None, found(image)))
    for error in (own, known):
        assert np.all(np.abs(error.mean(axis=0)) < 4 * error.std(axis=0) / np.sqrt(80))
    assert known.std() < own.std()


@pytest.mark.parametrize("k", [0, 7])
def test_spots_without_a_known_light_keep_their_own(k):
    image, given = painted(np.random.default_rng(6)), true_gradients()
    given[k] = np.nan
    mixed, own = fit_spots(image, centres(), axes(80), given), fit_spots(image, centres(), axes(80))
    np.testing.assert_allclose(mixed.centres_px[k], own.centres_px[k], atol=2e-3)
