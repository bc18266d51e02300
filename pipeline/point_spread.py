"""The camera's point spread, from how sharp the calibration board's spots appear at different heights.

A point is spread by diffraction at a circular pupil, by a disc where it is out of focus, and by the square pixel:
Airy pattern * disc * box, whose transfer functions are multiplied. The Airy pattern has one parameter, the cut-off
frequency of its transfer function. The disc's radius grows linearly with the distance from the surface in focus, and
that surface is a plane with the lens's field curvature on top.

A Gaussian would be simpler and is not good enough: the Airy pattern's skirt, in which a Gaussian has no light, lies
where the brightness of metal differs most from that of the pixel itself. Gaussians serve to *compare* spreads, for
the spots' fits report the Gaussian that suits a spot's edge best; here the same fits are made of computed pictures of
spots, and the parameters are those for which both agree. Whatever the fits make of an edge that is not Gaussian, of
their finite window and of the pixel's box is then the same on both sides.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import RectBivariateSpline
from scipy.optimize import least_squares
from scipy.special import j1

from greenough.instrument.contract import SpotBoard
from greenough.instrument.errors import InputError

from .camera_calibration import CameraCalibration
from .spot_fit import fit_spots
from .spots import Spots

MIN_SPOTS = 60
"""For 6 parameters, of which 4 describe the surface in focus."""

_CUTOFFS = np.geomspace(0.2, 1.6, 8)  # cycles per px
_DISC_RADII_PX = np.linspace(0.0, 6.0, 9)
_OVERSAMPLING = 2  # of the computed spots: the pixel's box lets hardly more through
_MARGIN_PX = 24  # around a computed spot
_LEAST_DEFOCUS = 0.01  # of the blur's mean square, that defocus must add on average
_SCALE_PX = 0.02  # of the loss: beyond it residuals count less than their square


@dataclass(frozen=True)
class PointSpread:
    """How the camera spreads the light of a point.

    Parameters
    ----------
    cutoff_per_px : float
        Highest spatial frequency that passes the lens, 2 NA / wavelength, in cycles per px.
    defocus_px_per_mm : float
        Radius of the disc of defocus per height above or below the surface in focus.
    focus_mm : tuple of 4 floats
        World height of the surface in focus, c + a x + b y + d (x² + y²), where (x, y) are px from the picture's
        middle: (c, a, b, d).
    shape : tuple of int
        (rows, cols) of the camera.
    """

    cutoff_per_px: float
    defocus_px_per_mm: float
    focus_mm: tuple[float, float, float, float]
    shape: tuple[int, int]

    def disc_radius_px(self, pixels: np.ndarray, height_mm: np.ndarray) -> np.ndarray:
        """Radius of the disc of defocus (...) of points at heights (...) seen at ``pixels`` (..., 2), (u, v)."""
        return self.defocus_px_per_mm * np.abs(self.defocus_mm(pixels, height_mm))

    def defocus_mm(self, pixels: np.ndarray, height_mm: np.ndarray) -> np.ndarray:
        """Height (...) over the surface in focus of points at heights (...) seen at ``pixels`` (..., 2), (u, v)."""
        return height_mm - _surface_terms(pixels, self.shape) @ np.array(self.focus_mm)

    def focus_rise(self, pixels: np.ndarray) -> np.ndarray:
        """Rise (..., 2) of the surface in focus along u and v, mm per px, at ``pixels`` (..., 2)."""
        _, *tilt, curvature = self.focus_mm
        return tilt + 2 * curvature * (pixels - (np.array(self.shape[::-1]) - 1) / 2)

    def transfer(self, shape: tuple[int, int], disc_radius_px: float) -> np.ndarray:
        """Transfer function (rows, cols) float32 in the order of ``fft2``: real, for the spread is symmetric."""
        v, u = np.fft.fftfreq(shape[0])[:, None], np.fft.fftfreq(shape[1])
        return _transfer(u, v, self.cutoff_per_px, disc_radius_px).astype(np.float32)


def estimate_point_spread(spots: Sequence[Spots], camera: CameraCalibration, board: SpotBoard) -> PointSpread:
    """Fit the point spread to the blur of the spots' edges in all postures.

    Parameters
    ----------
    spots : sequence of Spots
        One per posture, with ``blur_px``: the postures that ``camera`` was calibrated from.
    camera : CameraCalibration
        Tells the world heights of the spots.
    board : SpotBoard

    Raises
    ------
    InputError
        Too few spots, or spots at too few different heights to tell defocus from diffraction.
    """
    height = camera.spot_heights(board)
    centres, axes = (np.array([getattr(each, name) for each in spots]) for name in ("centres_px", "axes_px"))
    blur = np.array([np.full(len(each.sigma_px), np.nan) if each.blur_px is None else each.blur_px for each in spots])
    big = np.broadcast_to(board.diameters() > np.mean([board.big_diameter_mm, board.small_diameter_mm]), blur.shape)
    seen = np.isfinite(blur)
    if seen.sum() < MIN_SPOTS:
        raise InputError(
            f"the point spread cannot be estimated from {seen.sum()} spots: at least {MIN_SPOTS} are needed; show the "
            "board in more postures"
        )
    place = _surface_terms(centres[seen], camera.camera.shape)
    height, blur, big = height[seen], blur[seen], big[seen]
    radius = np.sqrt(axes[seen].prod(axis=1))
    tables = {kind: _blur_of_edges(float(np.median(radius[big == kind]))) for kind in np.unique(big)}

    def misfit(parameters: np.ndarray) -> np.ndarray:
        cutoff, per_mm = np.exp(parameters[:2])
        disc = np.abs(per_mm * (height - place @ parameters[2:]))
        expected = np.empty_like(blur)
        for kind, table in tables.items():
            expected[big == kind] = table.ev(np.log(cutoff), disc[big == kind])
        return expected - blur

    fit = least_squares(misfit, _start(height, place, blur), loss="soft_l1", f_scale=_SCALE_PX, x_scale="jac")
    cutoff, per_mm = (float(value) for value in np.exp(fit.x[:2]))
    c, a, b, d = (float(value) for value in fit.x[2:])
    return PointSpread(cutoff, per_mm, (c, a, b, d), camera.camera.shape)


def _start(height: np.ndarray, place: np.ndarray, blur: np.ndarray) -> np.ndarray:
    """Logarithms of cut-off and defocus, then the surface in focus, flat: blur² is a parabola over height.

    A disc of radius r adds r²/4 to the variance along each axis.
    """
    offset = height - height.mean()
    parabola = np.stack([np.ones_like(offset), offset, offset**2], axis=-1)
    middle, slope, curvature = np.linalg.lstsq(parabola, blur**2, rcond=None)[0]
    if curvature * np.var(height) <= _LEAST_DEFOCUS * middle:
        raise InputError(
            f"the point spread cannot be estimated: the spots' heights, {height.min():.2f} to {height.max():.2f} mm, "
            "do not show how defocus grows; tilt the board more"
        )
    focus = np.clip(height.mean() - slope / (2 * curvature), height.min(), height.max())
    return np.array([np.log(0.5), np.log(2 * np.sqrt(curvature)), focus, 0.0, 0.0, 0.0])


def _surface_terms(pixels: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """(..., 4) of pixels (..., 2)."""
    x, y = np.moveaxis(pixels - (np.array(shape[::-1]) - 1) / 2, -1, 0)
    return np.stack([np.ones_like(x), x, y, x * x + y * y], axis=-1)


def _transfer(u: np.ndarray, v: np.ndarray, cutoff: float, disc_radius_px: float) -> np.ndarray:
    """Transfer function at frequencies (u, v) in cycles per px: overlap of two pupils, disc, and the pixel's box."""
    radial = np.hypot(u, v)
    q = np.minimum(radial / cutoff, 1.0)
    lens = 2 / np.pi * (np.arccos(q) - q * np.sqrt(1 - q * q))
    return lens * _disc_transform(radial, disc_radius_px) * np.sinc(u) * np.sinc(v)


def _disc_transform(radial: np.ndarray, radius: float) -> np.ndarray:
    """Fourier transform of a disc of volume 1."""
    x = 2 * np.pi * radius * radial
    return np.where(x < 1e-6, 1.0, 2 * j1(x) / np.where(x < 1e-6, 1.0, x))


def _blur_of_edges(radius_px: float) -> RectBivariateSpline:
    """What a spot's fit says about its edge, px, over logarithm of the cut-off and radius of the disc of defocus."""
    side = 2 * int(np.ceil(radius_px) + _MARGIN_PX)
    frequency = np.fft.fftfreq(side * _OVERSAMPLING, 1 / _OVERSAMPLING)
    u, v = np.meshgrid(frequency, frequency)
    spot = np.pi * radius_px**2 * _disc_transform(np.hypot(u, v), radius_px) * _OVERSAMPLING**2
    pictures = [
        np.fft.fftshift(np.fft.ifft2(spot * _transfer(u, v, cutoff, disc)).real)[::_OVERSAMPLING, ::_OVERSAMPLING]
        for cutoff in _CUTOFFS
        for disc in _DISC_RADII_PX
    ]
    middles = np.column_stack([np.full(len(pictures), side / 2), side * (np.arange(len(pictures)) + 0.5)])
    blur = fit_spots(np.concatenate(pictures), middles, np.full((len(pictures), 2), radius_px)).blur_px
    return RectBivariateSpline(np.log(_CUTOFFS), _DISC_RADII_PX, blur.reshape(len(_CUTOFFS), len(_DISC_RADII_PX)))
