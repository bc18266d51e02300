"""Sub-pixel ellipse fits to bright spots, with a local contrast of their own for each.

A lens with coma blurs with a skew, and blur changes across a spot on a tilted board. A symmetric model fits best to
such an edge beside its mean, out of focus and differently at each height: a tilted board then seems to be tilted
otherwise, and heights get another scale. The mean of the light paths through the stop is what a ray can describe, for
it is straight. It is sought from the light itself, of which blur loses none: along the normal n of the rim, picture
minus model adds up to contrast times how far the edge's mean lies outside. For a circle,

    Σ (picture - model) n / ρ = contrast ∫ n (d·n) dθ = π contrast d

is the shift d of the centre, with ρ the distance from it; an ellipse is made a circle first.

This holds while the model has the right light. A gradient of it, a growing blur and a skewed edge look alike in one
spot: left to the fit, the gradient takes part of both others, and the centre goes along by more than the growth itself.
So the gradient should come from elsewhere, the brightness of the spots around (`spot_light`), and the growth of the
blur is fitted. What is then left of it does not depend on the spot or on the shape of its blur, and so can be put back
(`slope_blur`): with δ half the gradient of the blur's variance, centres lie at -2 δ. One δ is the model's edge,
Φ(-d / blur) with a blur that grows along d, whose mean lies there; the other that blur across the normal moves the rim
of a disc of radius R inwards by its variance / 2R, more where it is wider.
"""

from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

_ITERATIONS = 12
_CONVERGED_PX = 1e-4
_BLUR_CONVERGED_PX = 1e-3
_BLUR_START_PX = 1.3
_REACH = 3.0  # of an edge to either side, in units of its blur: 99.7 % of it; more adds noise
_HUB = 0.25  # of the radius, around the centre, where no edge is
_MARGIN_PX = 5  # of dark ink around the spot, at least
_PARAMETERS = 12
_LIGHT, _GROWTH = slice(8, 10), slice(10, 12)  # of these, gradients per half window
_FREE = 10
_LEAST_GROWN = 0.2  # of the blur, on the sharp side of a window
_WINDOW_STEP_PX = 4  # windows come in sizes of this step, so that spots can be fitted together


@dataclass(frozen=True)
class SpotFits:
    """Fitted spots; all NaN where a fit failed.

    Parameters
    ----------
    centres_px : (n, 2)
        Centres (u, v) of the ellipses.
    axes_px : (n, 2)
        Semi-axes, the longer first.
    sigma_px : (n,)
        Standard deviation of each coordinate of the centre, from the fit's own residual.
    blur_px : (n,)
        Standard deviation of the Gaussian that blurs the edge, the pixel's own area included.
    contrast_dn : (n,)
        Spot minus what is around it, at the centre.
    residual_dn : (n,)
        Root mean square of picture minus model.
    asymmetry_dn : (n,)
        Root mean square of the residual's odd part about the centre, scaled to equal ``residual_dn`` for white noise.
        Blur of another shape than assumed is even and moves no centre; the edge of the light or dirt is not.
    """

    centres_px: np.ndarray
    axes_px: np.ndarray
    sigma_px: np.ndarray
    blur_px: np.ndarray
    contrast_dn: np.ndarray
    residual_dn: np.ndarray
    asymmetry_dn: np.ndarray


def fit_spots(
    image: np.ndarray,
    centres_px: np.ndarray,
    axes_px: np.ndarray,
    light_per_px: np.ndarray | None = None,
    dark: bool = False,
) -> SpotFits:
    """Fit a blurred ellipse to the window around each spot.

    The model is ``(1 + g·x) (ink + contrast Φ(-d / blur))``, with d the distance from the ellipse to first order; ink,
    contrast and blur are each spot's own, and so is either the relative gradient g of the light or, if that is given,
    the relative gradient of the blur. What remains is that the optics blur light times reflectance while the model
    multiplies after blurring. For a Gaussian blur h,
    (x f) * h = x (f * h) + blur² (f * h)', so an edge in that light appears shifted by -blur² g; that is put back. The
    centre is then moved to where the edges' means say, which needs nothing of the blur's shape.

    Parameters
    ----------
    image : (rows, cols) float
    centres_px : (n, 2)
        Start, (u, v), within a fraction of the radius.
    axes_px : (n, 2)
        Start of the semi-axes.
    light_per_px : (n, 2), optional
        Relative gradient g of the light at each spot, if it is known.
    dark : bool
        Whether spots are darker than what is around them; their contrast is negative then.
    """
    count = len(centres_px)
    radius = axes_px.max(axis=1)
    half = np.ceil((radius + np.maximum(_MARGIN_PX, 0.3 * radius)) / _WINDOW_STEP_PX).astype(int) * _WINDOW_STEP_PX
    middle = np.rint(centres_px).astype(int)
    rows, cols = image.shape
    fits_in = np.all((middle >= half[:, None]) & (middle < [cols, rows] - half[:, None]), axis=1)
    light = np.full((count, 2), np.nan) if light_per_px is None else light_per_px
    result = np.full((count, 9), np.nan)
    for size in np.unique(half[fits_in]):
        group = np.flatnonzero(fits_in & (half == size))
        window = middle[group], int(size), centres_px[group], axes_px[group], light[group]
        result[group] = _fit_windows(image, *window, dark)
    return SpotFits(result[:, :2], result[:, 2:4], *result[:, 4:].T)


def _fit_windows(
    image: np.ndarray,
    middle: np.ndarray,
    half: int,
    centres_px: np.ndarray,
    axes_px: np.ndarray,
    light_per_px: np.ndarray,
    dark: bool,
) -> np.ndarray:
    """Gauss-Newton over windows of one size, all spots at once; (n, 9) columns in the order of SpotFits.

    ``light_per_px`` is NaN where the light's gradient is to be fitted.
    """
    count = len(middle)
    offset = np.arange(-half, half + 1)
    y, x = (grid.ravel().astype(float) for grid in np.meshgrid(offset, offset, indexing="ij"))  # (pixels,)
    pixels = image[middle[:, 1, None] + y.astype(int), middle[:, 0, None] + x.astype(int)].astype(float)  # (n, pixels)
    slopes = np.stack([x, y]) / half  # (2, pixels)

    # Of each spot: centre (2), q_xx, q_xy, q_yy times radius², blur, ink, contrast, gradients (2 and 2) of light and of
    # blur per half window.
    radius2 = np.square(axes_px).mean(axis=1)
    parameters = np.zeros((count, _PARAMETERS))
    known = np.isfinite(light_per_px)
    fixed = np.zeros((count, _PARAMETERS), bool)
    fixed[:, _LIGHT], fixed[:, _GROWTH] = known, ~known
    parameters[:, _LIGHT] = np.where(known, light_per_px * half, 0.0)
    parameters[:, :2] = centres_px - middle
    parameters[:, [2, 4]] = 1.0
    parameters[:, 5] = _BLUR_START_PX
    low, high = np.percentile(pixels, [10, 90], axis=1)
    parameters[:, 6], parameters[:, 7] = (high, low - high) if dark else (low, high - low)
    for _ in range(_ITERATIONS):
        model, jacobian = _blurred_ellipse(parameters, radius2, x, y, slopes)
        jacobian[fixed] = 0.0
        residual = pixels - model
        normal = jacobian @ jacobian.transpose(0, 2, 1)  # (n, parameters, parameters)
        normal[:, range(_PARAMETERS), range(_PARAMETERS)] *= 1.0 + 1e-9
        step = np.linalg.solve(normal + 1e-12 * np.eye(_PARAMETERS), (jacobian @ residual[..., None]))[..., 0]
        parameters += _limited(step)
        parameters[:, 5] = np.clip(parameters[:, 5], 0.3, 0.6 * np.sqrt(radius2))
        if np.abs(step[:, :2]).max() < _CONVERGED_PX and np.abs(step[:, 5]).max() < _BLUR_CONVERGED_PX:
            break
    model, jacobian = _blurred_ellipse(parameters, radius2, x, y, slopes)
    jacobian[fixed] = 0.0
    residual = pixels - model
    variance = np.sum(residual**2, axis=1) / (len(x) - _FREE)
    odd = (residual - residual[:, ::-1]) / np.sqrt(2.0)  # (x, y) -> (-x, -y) reverses the window's order
    to_mean = _edge_weights(parameters, radius2, x, y, slopes)  # (n, 2, pixels)
    # The centre is linear in the picture: the fit's centre and put-back gradient, and the shift by what the fit leaves.
    of_fit = np.zeros((count, 2, _PARAMETERS))
    of_fit[:, [0, 1], [0, 1]] = 1.0
    of_fit[:, [0, 1], [8, 9]] = parameters[:, 5, None] ** 2 / half
    covariance = np.linalg.inv(jacobian @ jacobian.transpose(0, 2, 1) + 1e-12 * np.eye(_PARAMETERS))
    weights = to_mean + (of_fit - to_mean @ jacobian.transpose(0, 2, 1)) @ covariance @ jacobian
    sigma = np.sqrt(variance * np.square(weights).sum(axis=(1, 2)) / 2)

    q_xx, q_xy, q_yy = parameters[:, 2:5].T / radius2
    mean, spread = (q_xx + q_yy) / 2, np.hypot((q_xx - q_yy) / 2, q_xy)
    with np.errstate(invalid="ignore", divide="ignore"):
        axes = 1.0 / np.sqrt(np.stack([mean - spread, mean + spread], axis=-1))
    blur, contrast = parameters[:, 5], parameters[:, 7]
    gradient = parameters[:, _LIGHT] / half  # relative, 1/px
    shift = np.einsum("nkp,np->nk", to_mean, residual)
    centres = middle + parameters[:, :2] + blur[:, None] ** 2 * gradient + shift
    table = np.column_stack([centres, axes, sigma, blur, contrast, np.sqrt(variance), np.sqrt(np.mean(odd**2, axis=1))])
    bad = ~np.isfinite(table).all(axis=1) | (np.abs(step[:, :2]).max(axis=1) > 0.01) | ((contrast < 0) != dark)
    table[bad] = np.nan
    return table


def _edge_weights(
    parameters: np.ndarray, radius2: np.ndarray, x: np.ndarray, y: np.ndarray, slopes: np.ndarray
) -> np.ndarray:
    """Weights (n, 2, pixels) of picture minus model whose sum is the shift of the edges' mean, px."""
    form = np.empty((len(parameters), 2, 2))
    form[:, 0, 0], form[:, 1, 1] = parameters[:, 2] / radius2, parameters[:, 4] / radius2
    form[:, 0, 1] = form[:, 1, 0] = parameters[:, 3] / radius2
    with np.errstate(invalid="ignore"):
        values, vectors = np.linalg.eigh(form)
        root = np.sqrt(np.maximum(values, 1e-12))
    to_circle = root[:, :, None] * vectors.transpose(0, 2, 1)  # of radius 1
    offset = np.stack([x - parameters[:, 0, None], y - parameters[:, 1, None]], axis=1)  # (n, 2, pixels)
    on_circle = to_circle @ offset
    radius = np.maximum(np.linalg.norm(on_circle, axis=1), 1e-6)  # (n, pixels)
    distance = np.abs(radius - 1.0) / root.mean(axis=1, keepdims=True)
    near = (distance < _REACH * parameters[:, 5, None]) & (radius > _HUB)  # 1 / ρ² is endless in the middle
    light = 1.0 + parameters[:, _LIGHT] @ slopes
    contrast, area = parameters[:, 7, None], root.prod(axis=1)[:, None]
    weight = np.where(near, area / (np.pi * contrast * light * radius**2), 0.0)
    return np.linalg.solve(to_circle, on_circle * weight[:, None])


def _limited(step: np.ndarray) -> np.ndarray:
    """Keep the first steps inside the region where the linearised edge still means something."""
    limits = np.array([2.0, 2.0, 0.3, 0.3, 0.3, 0.5, np.inf, np.inf, np.inf, np.inf, 0.2, 0.2])
    return np.clip(np.nan_to_num(step), -limits, limits)


def _blurred_ellipse(
    parameters: np.ndarray, radius2: np.ndarray, x: np.ndarray, y: np.ndarray, slopes: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Model (n, pixels) and its derivatives (n, parameters, pixels)."""
    cx, cy, q_xx, q_xy, q_yy, blur = (column[:, None] for column in parameters[:, :6].T)
    dx, dy = x - cx, y - cy
    gx, gy = (q_xx * dx + q_xy * dy) / radius2[:, None], (q_xy * dx + q_yy * dy) / radius2[:, None]
    form = np.maximum(dx * gx + dy * gy, 1e-12)
    root = np.sqrt(form)  # 1 on the ellipse
    # (root - 1) / |gradient of root|; the gradient's own change is left out of the derivatives: it vanishes on the rim.
    slope = root / np.maximum(np.hypot(gx, gy), 1e-12)
    grown = np.maximum(1.0 + parameters[:, _GROWTH] @ slopes, _LEAST_GROWN)
    blur = blur * grown
    scaled = (root - 1.0) * slope / blur
    inside = ndtr(-scaled)
    density = np.exp(-0.5 * scaled**2) / np.sqrt(2.0 * np.pi)
    ink, contrast = parameters[:, 6, None], parameters[:, 7, None]
    light = 1.0 + parameters[:, _LIGHT] @ slopes
    reflected = ink + contrast * inside
    by_root = -light * contrast * density * slope / blur  # d model / d root
    by_form = by_root / (2.0 * root * radius2[:, None])
    widening = light * contrast * density * scaled / grown
    jacobian = np.empty((len(parameters), _PARAMETERS, len(x)))
    jacobian[:, 0] = -by_root * gx / root
    jacobian[:, 1] = -by_root * gy / root
    jacobian[:, 2] = by_form * dx * dx
    jacobian[:, 3] = by_form * 2.0 * dx * dy
    jacobian[:, 4] = by_form * dy * dy
    jacobian[:, 5] = widening / parameters[:, 5, None]
    jacobian[:, 6] = light
    jacobian[:, 7] = light * inside
    jacobian[:, _LIGHT] = slopes * reflected[:, None]
    jacobian[:, _GROWTH] = slopes * widening[:, None]
    return light * reflected, jacobian
