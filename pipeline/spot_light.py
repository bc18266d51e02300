"""How the light changes across each spot, from how bright the spots around are."""

import numpy as np

HEART = 0.35
"""Of a spot's half axis, within which its brightness is taken: there blur hardly changes it. The contrast of a fit does
change, by what the fit cannot follow of an edge, and so would show a gradient of light wherever blur grows."""

_DEGREES = (2, 3, 4)
_SPOTS_PER_TERM = 2  # at least
_ROUNDS = 3
_OUTLIER = 4.0  # standard deviations, told by the median


def light_gradients(image: np.ndarray, centres_px: np.ndarray, axes_px: np.ndarray) -> np.ndarray | None:
    """Relative gradient (n, 2) of the light at each spot, 1/px; None where too few spots tell.

    The logarithm of the brightness is taken for a polynomial over the picture, of degree 4 where there are spots
    enough. Diffraction carries light out of a spot, more of it the smaller it is: in inverse proportion to the radius.
    Spots that are brighter or darker than the others around them, for dirt or a flaw of the print, do not count.

    Parameters
    ----------
    image : (rows, cols)
    centres_px, axes_px : (n, 2)
        Of the spots, NaN where a fit has failed; the gradient there is NaN.
    """
    brightness = _brightness(image, centres_px, HEART * axes_px.min(axis=1))
    used = brightness > 0
    degrees = [d for d in _DEGREES if _SPOTS_PER_TERM * ((d + 1) * (d + 2) // 2 + 1) <= used.sum()]
    if not degrees:
        return None
    powers = [(i, j) for i in range(degrees[-1] + 1) for j in range(degrees[-1] + 1 - i)]
    middle, reach = centres_px[used].mean(axis=0), np.ptp(centres_px[used], axis=0).max() / 2
    x, y = ((centres_px - middle) / reach).T
    curvature = 1.0 / np.sqrt(axes_px.prod(axis=1))
    design = np.stack([x**i * y**j for i, j in powers] + [curvature / np.mean(curvature[used])], axis=-1)
    level = np.log(brightness, where=used, out=np.full(len(used), np.nan))
    terms = np.zeros(design.shape[1])
    for _ in range(_ROUNDS):
        terms = np.linalg.lstsq(design[used], level[used], rcond=None)[0]
        left = np.abs(level - design @ terms)
        used = left <= max(_OUTLIER * float(np.median(left[used])) / 0.6745, 1e-9)
    along = np.zeros((2, len(level)))
    for (i, j), term in zip(powers, terms, strict=False):
        along += term * np.stack([i * x ** max(i - 1, 0) * y**j, j * x**i * y ** max(j - 1, 0)])
    return along.T / reach


def _brightness(image: np.ndarray, centres_px: np.ndarray, reach_px: np.ndarray) -> np.ndarray:
    """Mean grey value (n,) within ``reach_px`` of each centre, pixels at the rim in part; NaN without a centre."""
    mean = np.full(len(centres_px), np.nan)
    for k in np.flatnonzero(np.isfinite(reach_px)):
        (u, v), reach = centres_px[k], reach_px[k]
        cols = np.arange(int(u - reach - 1), int(u + reach + 2))
        rows = np.arange(int(v - reach - 1), int(v + reach + 2))
        weight = np.clip(reach + 0.5 - np.hypot(cols - u, rows[:, None] - v), 0.0, 1.0)
        mean[k] = np.sum(weight * image[rows[0] : rows[-1] + 1, cols[0] : cols[-1] + 1]) / weight.sum()
    return mean
