"""Finds the calibration board's spots in a picture and measures their centres."""

from dataclasses import dataclass

import cv2
import numpy as np

from greenough.instrument.contract import SpotBoard
from greenough.instrument.errors import InputError

from .spot_fit import SpotFits, fit_spots
from .spot_grid import MIN_SPOTS, BoardNotFound, order_spots
from .spot_light import light_gradients

__all__ = ["BoardNotFound", "Spots", "detect_spots"]

_WINDOW_SHARE = 0.1  # of the picture's width: a neighbourhood that holds a spot wherever the grid is
_REDUCTION = 4  # the local levels vary slowly: they are taken from a picture this much smaller
_LEVEL = 0.45  # between the local dark (0) and bright (1) level
_MIN_CONTRAST = 0.1  # of the picture's brightest part
_MISFIT = 0.06  # residual of a fit against its contrast beyond which the spot is no ellipse
_ASYMMETRY = 0.008  # the same for its odd part, beyond the other spots': this moves the centre
_SIZE_TOLERANCE = 0.06  # semi-axes against those of the other spots
_PLACE_TOLERANCE = 0.03  # of a pitch: distance from the homography through all spots (distortion, print)


@dataclass(frozen=True)
class Spots:
    """Spots of one picture in the board's order, row by row; NaN where a spot was not seen.

    Parameters
    ----------
    centres_px : (rows * cols, 2)
        Centres (u, v) of the ellipses as imaged: not the images of the circles' centres, from which they differ by the
        eccentricity (see ``CameraModel.project_circles``).
    axes_px : (rows * cols, 2)
        Semi-axes at half contrast, the longer first; blur makes them shorter by blur² / 2R.
    sigma_px : (rows * cols,)
        Standard deviation of each coordinate of a centre, from the fit's own residual.
    blur_px : (rows * cols,), optional
        Standard deviation of the Gaussian that blurs the edge, the pixel's own area included.
    """

    centres_px: np.ndarray
    axes_px: np.ndarray
    sigma_px: np.ndarray
    blur_px: np.ndarray | None = None

    @property
    def seen(self) -> np.ndarray:
        """(rows * cols,) bool."""
        return np.isfinite(self.sigma_px)


def detect_spots(image: np.ndarray, board: SpotBoard) -> Spots:
    """Find the board's spots, white ones on dark ink or dark ones on white.

    The board may be turned, tilted, shifted, partly out of the picture or of the light, and unevenly lit; its grid
    must span between a third of the picture's width and all of it. Blobs brighter (or darker) than the middle of the
    *local* dark and bright levels are put into the board's order, then measured by
    :func:`greenough.pipeline.spot_fit.fit_spots`. A spot whose picture is no ellipse (cut by the edge of the light,
    dirty), or whose size or place does not go with the others, counts as unseen.

    Parameters
    ----------
    image : (rows, cols)
        Grey values above black, e.g. the fringes' background, in which the light is not modulated.

    Raises
    ------
    BoardNotFound
        Fewer than 20 spots form the board's grid, or the big ones do not tell how it lies.
    InputError
        The picture is not two-dimensional or not finite.
    """
    if image.ndim != 2 or not np.isfinite(image).all():
        raise InputError(
            f"a picture of spots must be (rows, cols) and finite everywhere, but this one has shape {image.shape}"
            + ("" if image.ndim != 2 else " and holds values that are not finite")
        )
    image = np.ascontiguousarray(image, dtype=np.float32)
    centres, axes = _bright_blobs(image.max() - image if board.dark_spots else image)
    index = order_spots(centres, np.pi * axes.prod(axis=1), board)
    spot = np.flatnonzero(index >= 0)
    fits = fit_spots(image, centres[index[spot]], axes[index[spot]], dark=board.dark_spots)
    # Dark spots are too dark to tell the light around them: each fit then tells its own.
    light = None if board.dark_spots else light_gradients(image, fits.centres_px, fits.axes_px)
    if light is not None:
        fits = fit_spots(image, centres[index[spot]], axes[index[spot]], light)
    good = _consistent(fits, spot, board, _noise_dn(image))
    if good.sum() < MIN_SPOTS:
        raise BoardNotFound(
            f"calibration board not found: {len(spot)} spots of its grid were seen but only {good.sum()} of them are "
            f"sharp, evenly lit ellipses, and at least {MIN_SPOTS} are needed; check focus, light and dirt"
        )
    total = board.rows * board.cols
    seen = spot[good]

    def in_order(values: np.ndarray) -> np.ndarray:
        ordered = np.full((total, *values.shape[1:]), np.nan)
        ordered[seen] = values[good]
        return ordered

    return Spots(in_order(fits.centres_px), in_order(fits.axes_px), in_order(fits.sigma_px), in_order(fits.blur_px))


def _noise_dn(image: np.ndarray) -> float:
    """Standard deviation of white noise: median absolute second difference, which smooth light does not reach."""
    second = image[:, 2:] - 2.0 * image[:, 1:-1] + image[:, :-2]
    return float(np.median(np.abs(second[::4])) / 0.6745 / np.sqrt(6.0))


def _bright_blobs(image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Centres (n, 2) and semi-axes (n, 2) in px of bright, compact, roughly elliptic blobs, by their moments."""
    rows, cols = image.shape
    smooth = cv2.GaussianBlur(image, (0, 0), 1.0)
    small = cv2.resize(smooth, (cols // _REDUCTION, rows // _REDUCTION), interpolation=cv2.INTER_AREA)
    side = 2 * round(_WINDOW_SHARE * cols / _REDUCTION / 2) + 1
    window = np.ones((side, side), np.uint8)
    dark, bright = cv2.erode(small, window), cv2.dilate(small, window)
    enough = max(_MIN_CONTRAST * float(np.percentile(small, 99.5)), 4.0 * _noise_dn(image), 1e-6)
    level = np.where(bright - dark > enough, dark + _LEVEL * (bright - dark), np.inf).astype(np.float32)
    mask = smooth > cv2.resize(level, (cols, rows), interpolation=cv2.INTER_NEAREST)
    count, blob, stats, middles = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=4)

    area = stats[:, cv2.CC_STAT_AREA].astype(float)
    left, top = stats[:, cv2.CC_STAT_LEFT], stats[:, cv2.CC_STAT_TOP]
    width, height = stats[:, cv2.CC_STAT_WIDTH], stats[:, cv2.CC_STAT_HEIGHT]
    inside = (left > 0) & (top > 0) & (left + width < cols) & (top + height < rows)
    v, u = np.nonzero(mask)
    which = np.asarray(blob, dtype=np.intp)[v, u]
    middle_u, middle_v = np.asarray(middles)[which].T
    du, dv = u - middle_u, v - middle_v
    # A filled ellipse has a variance of axis²/4 along each axis; a pixel adds its own 1/12.
    uu, uv, vv = (np.bincount(which, weights=product, minlength=count) for product in (du * du, du * dv, dv * dv))
    uu, uv, vv = uu / area + 1 / 12, uv / area, vv / area + 1 / 12
    mean, spread = (uu + vv) / 2, np.hypot((uu - vv) / 2, uv)
    axes = 2.0 * np.sqrt(np.stack([mean + spread, np.maximum(mean - spread, 1e-9)], axis=-1))
    fill = area / (np.pi * axes.prod(axis=1))
    keep = inside & (area >= 20) & (axes[:, 1] > 0.6 * axes[:, 0]) & (fill > 0.9) & (fill < 1.1)
    keep[0] = False  # the background
    return middles[keep], axes[keep]


def _consistent(fits: SpotFits, spot: np.ndarray, board: SpotBoard, noise_dn: float) -> np.ndarray:
    """Which fits are whole spots of this board, by their residual, their size and their place."""
    good = np.isfinite(fits.sigma_px)
    with np.errstate(invalid="ignore"):
        good &= fits.residual_dn < np.hypot(2.0 * noise_dn, _MISFIT * fits.contrast_dn)
        typical = np.median(fits.asymmetry_dn[good]) if good.any() else np.nan
        good &= fits.asymmetry_dn < np.hypot(1.1 * typical, _ASYMMETRY * fits.contrast_dn)
    nominal, radii = board.centres()[spot], board.diameters()[spot] / 2
    for _ in range(2):
        if good.sum() < MIN_SPOTS:
            break
        homography, _ = cv2.findHomography(nominal[good], fits.centres_px[good])
        homogeneous = np.column_stack([nominal, np.ones(len(nominal))]) @ homography.T
        place = homogeneous[:, :2] / homogeneous[:, 2:]
        scale = np.sqrt(np.abs(np.linalg.det(homography) / homogeneous[:, 2] ** 3))  # px per mm, areal
        with np.errstate(invalid="ignore"):
            size = np.sqrt(fits.axes_px.prod(axis=1)) / (scale * radii)
            astray = np.hypot(*(fits.centres_px - place).T) / (scale * board.pitch_mm)
            for kind in np.unique(radii):
                same = radii == kind
                typical = np.median(size[same & good]) if np.any(same & good) else np.nan
                good &= ~same | (np.abs(size / typical - 1.0) < _SIZE_TOLERANCE)
            good &= astray < _PLACE_TOLERANCE
    return good
