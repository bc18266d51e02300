"""Takes out what the camera's blur does to the phase where brightness changes.

A pixel sees Z = h * (L exp(iΦ)), with h the point spread and L the brightness: its phase arg Z is drawn from its own Φ
towards that of its brighter neighbours. Inverting h as a filter on Z would undo that and multiply the phase's noise.
But a surface is smoother than its brightness, and the drag

    D = arg(h * (L exp(iΦ))) - Φ

needs Φ only as differences over a point spread, which may be averaged, and L, whose noise hardly matters: it acts
through the phase's change over a point spread, a fraction of a radian. So L is deconvolved, Φ is not, and the measured
phase less D is returned. D is computed again from what that gives.

L is found by multiplicative steps (the image space reconstruction algorithm of Daube-Witherspoon and Muehllehner,
1986), which lower Σ (|Z| - |h * (L exp(iΦ))|)² / variance and keep L positive; they end when the difference
has come down to the noise. Φ in D is averaged by local planes, which brightness does not draw aside.

Noise in L passes through h(d) k·d, with k the phase's gradient; noise in Φ through the averaging and 1 - h. Both are
linear filters, from which follows by how much ``sigma`` grows.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy import fft
from scipy.ndimage import distance_transform_edt

from greenough.instrument.errors import InputError

from .decode import PhaseMap
from .jit import dr
from .local_planes import LocalPlanes
from .phasor_filter import linear_course
from .point_spread import PointSpread

MARGIN_PX = 24
"""Around the picture, from which light is blurred into it."""

LAYER_PX = 0.4
"""Step of the disc of defocus for which transfer functions are made; between them they are interpolated."""

AVERAGE_SIGMA_PX = 1.8
"""Of the Gaussian under which the phase in the drag is averaged; an Airy disc of 2.2 px radius is as wide as that."""

_PHASE_STEPS = 2
_BRIGHTNESS_STEPS = 3  # for each of them
_DARK_SIGMA = 0.1  # rad; invalid pixels with less noise are not dark, but saturated or inconsistent
_LEAST_SD = 1e-5  # of the largest modulation: keeps the weights of perfect frames finite
_LEAST_SEEN = 1e-5  # of the largest; single precision leaves 1e-7


def deconvolve_phasors(phase_map: PhaseMap, point_spread: PointSpread, height_mm: np.ndarray) -> PhaseMap:
    """Free the phase from the drag of blur times brightness.

    Invalid pixels stay invalid. As sources of light they count with their modulation where they are dark; saturated
    ones, and what lies outside the picture, are as bright as their surroundings require, and as uncertain as bright.

    Parameters
    ----------
    phase_map : PhaseMap
        Unfiltered, with ``sigma`` from the camera's noise or a merge's variance.
    point_spread : PointSpread
        Of this camera.
    height_mm : (rows, cols)
        World height of each pixel's point from a first reconstruction, NaN where unknown: it decides the defocus, for
        which the drag itself does not matter.

    Returns
    -------
    PhaseMap
        With ``absolute``, ``modulation`` and ``sigma`` deconvolved where valid; the rest as it was.

    Raises
    ------
    InputError
        If the phase map or the heights are not of the point spread's picture size.
    """
    for what, shape in (("phase map", phase_map.valid.shape), ("height map", height_mm.shape)):
        if tuple(shape) != tuple(point_spread.shape):
            raise InputError(
                f"the {what} has shape {tuple(shape)} but the point spread is of a camera of {point_spread.shape} "
                "pixels: estimate this camera's"
            )
    valid = phase_map.valid
    if not valid.any():
        return phase_map

    padding = _Padding(valid.shape)
    inner, inside = padding.inner, padding.embed(valid)
    with np.errstate(invalid="ignore"):
        amplitude_sd = phase_map.modulation * phase_map.sigma
        dark = ~valid & np.isfinite(amplitude_sd) & (phase_map.sigma > _DARK_SIGMA)
    known = padding.embed(valid | dark)
    nearest_known, nearest_valid = _nearest(known), _nearest(inside)
    modulation = padding.embed(phase_map.modulation)[nearest_known].astype(np.float64)
    amplitude_sd = padding.embed(amplitude_sd)[nearest_known].astype(np.float64)
    amplitude_sd = np.maximum(amplitude_sd, _LEAST_SD * modulation.max())
    disc_radius = _disc_radius(point_spread, height_mm)
    blur = _Blur(point_spread, padding.embed(disc_radius)[_nearest(padding.embed(np.ones_like(valid)))])

    # Without the phase's linear course, what lies outside goes on as the fringes do, not as one phase.
    course = linear_course(phase_map.absolute, valid)
    measured = _Measured(
        modulation=modulation,
        weight=np.where(known, amplitude_sd**-2.0, 0.0),
        phase=padding.embed(np.where(valid, phase_map.absolute - course, 0.0)),
        phase_weight=np.where(inside, (modulation / amplitude_sd) ** 2, 0.0),
        carrier=np.exp(1j * padding.continued(course)).astype(np.complex64),
    )
    freed = _free(measured, blur, nearest_valid)

    gradient_square = _gradient_square(freed.averaged + padding.continued(course))
    own, others = _noise_gain(blur, np.where(known, amplitude_sd, modulation) ** 2, gradient_square, freed.steps)
    with np.errstate(divide="ignore", invalid="ignore"):
        sigma = np.sqrt(own[inner] * phase_map.sigma**2 + others[inner] / freed.amplitude[inner] ** 2)
    dtype = phase_map.absolute.dtype
    return replace(
        phase_map,
        absolute=np.where(valid, freed.phase[inner] + course, np.nan).astype(dtype),
        modulation=np.where(valid, freed.brightness[inner], phase_map.modulation).astype(dtype),
        sigma=np.where(valid, sigma, phase_map.sigma).astype(dtype),
    )


@dataclass(frozen=True, eq=False)
class _Measured:
    """What the camera saw, with a margin around; all (rows, cols)."""

    modulation: np.ndarray
    weight: np.ndarray  # inverse variance of the modulation, 0 where unknown
    phase: np.ndarray  # less the carrier's
    phase_weight: np.ndarray  # inverse variance of the phase, 0 where not valid
    carrier: np.ndarray  # exp(i linear course)


@dataclass(frozen=True, eq=False)
class _Freed:
    """What the camera would have seen without blur; all (rows, cols)."""

    phase: np.ndarray  # less the carrier's
    averaged: np.ndarray  # the phase before, averaged
    brightness: np.ndarray
    amplitude: np.ndarray  # |Z| that follows from it
    steps: int  # that the brightness took


def _free(measured: _Measured, blur: "_Blur", nearest_valid: tuple[np.ndarray, np.ndarray]) -> _Freed:
    """Brightness and phase in turn, each with the other as it is by then."""
    weight, modulation = measured.weight, measured.modulation
    wanted = blur.transposed(weight * modulation)
    brightness, phase, steps = modulation, measured.phase, 0
    averaged, blurred = phase, measured.carrier
    planes = LocalPlanes.under(measured.phase_weight, AVERAGE_SIGMA_PX)
    for _ in range(_PHASE_STEPS):
        averaged = planes.fit(phase)[nearest_valid]
        rotor = measured.carrier * np.exp(1j * averaged).astype(np.complex64)
        blurred = blur.forward(brightness * rotor)
        for _ in range(_BRIGHTNESS_STEPS):
            if np.sum(weight * (np.abs(blurred) - modulation) ** 2) <= np.count_nonzero(weight):
                break
            brightness = brightness * _ratio(wanted, blur.transposed(weight * np.abs(blurred)))
            blurred = blur.forward(brightness * rotor)
            steps += 1
        phase = measured.phase - np.angle(blurred * np.conj(rotor))
    return _Freed(phase, averaged, brightness, np.abs(blurred), steps)


class _Padding:
    """Pictures with a margin, in a size that transforms quickly."""

    def __init__(self, shape: tuple[int, ...]):
        self.shape = shape
        self.size = tuple(cv2.getOptimalDFTSize(n + 2 * MARGIN_PX) for n in shape)
        self.inner = tuple(slice(MARGIN_PX, MARGIN_PX + n) for n in shape)

    def embed(self, image: np.ndarray) -> np.ndarray:
        """With zeros around."""
        whole = np.zeros(self.size, image.dtype)
        whole[self.inner] = image
        return whole

    def continued(self, course: np.ndarray) -> np.ndarray:
        """A linear course over the picture and its margin."""
        v, u = (np.arange(size) - MARGIN_PX for size in self.size)
        along, down = course[0, -1] - course[0, 0], course[-1, 0] - course[0, 0]
        rows, cols = self.shape
        return course[0, 0] + along * u / max(cols - 1, 1) + down * v[:, None] / max(rows - 1, 1)


def _nearest(known: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Index of each pixel's nearest known one."""
    index = np.asarray(distance_transform_edt(~known, return_distances=False, return_indices=True))
    return index[0], index[1]


def _disc_radius(point_spread: PointSpread, height_mm: np.ndarray) -> np.ndarray:
    """Radius of the disc of defocus in px, (rows, cols), where a height is unknown at the nearest known one."""
    known = np.isfinite(height_mm)
    height = height_mm[_nearest(known)] if known.any() else np.zeros_like(height_mm)
    v, u = np.mgrid[: height.shape[0], : height.shape[1]]
    return point_spread.disc_radius_px(np.stack([u, v], axis=-1), height)


def _ratio(wanted: np.ndarray, present: np.ndarray) -> np.ndarray:
    """Factor of a multiplicative step; 1 where no known pixel sees enough for the transforms' rounding not to count."""
    seen = present > _LEAST_SEEN * present.max()
    return np.where(seen, np.maximum(wanted, 0) / np.where(seen, present, 1), 1)


def _gradient_square(phase: np.ndarray) -> np.ndarray:
    """|∇Φ|² in rad²/px²."""
    down, along = np.gradient(phase)
    return down**2 + along**2


class _Blur:
    """The point spread over a picture whose parts are differently out of focus."""

    def __init__(self, point_spread: PointSpread, disc_radius_px: np.ndarray):
        level = disc_radius_px / LAYER_PX
        self.shape = level.shape
        self.layers: list[tuple[np.ndarray, np.ndarray]] = []  # share of each pixel, transfer function
        for layer in range(int(np.ceil(level.max())) + 1):
            share = np.clip(1 - np.abs(level - layer), 0, None).astype(np.float32)
            if share.any():
                self.layers.append((share, point_spread.transfer(self.shape, layer * LAYER_PX)))

    def forward(self, picture: np.ndarray) -> np.ndarray:
        """Each pixel's complex light spread as its own defocus spreads it."""
        picture = picture.astype(np.complex64)
        spectrum = np.zeros(self.shape, np.complex64)
        for share, transfer in self.layers:
            spectrum += np.asarray(fft.fft2(picture * share, workers=dr.thread_count())) * transfer
        return np.asarray(fft.ifft2(spectrum, workers=dr.thread_count()))

    def transposed(self, picture: np.ndarray) -> np.ndarray:
        """What each pixel's light meets of a real picture."""
        met = np.zeros(self.shape, np.float32)
        for share, transfer in self.layers:
            met += share * _convolved(picture, transfer)
        return met


def _convolved(picture: np.ndarray, transfer: np.ndarray) -> np.ndarray:
    """Real picture by a real transfer function in the order of ``fft2``."""
    spectrum = np.asarray(fft.rfft2(picture.astype(np.float32), workers=dr.thread_count()))
    return np.asarray(fft.irfft2(spectrum * transfer[:, : spectrum.shape[1]], picture.shape, workers=dr.thread_count()))


def _kernel(transfer: np.ndarray) -> np.ndarray:
    """Real response, its middle at the first pixel, of a transfer function."""
    return np.real(np.asarray(fft.ifft2(transfer, workers=dr.thread_count())))


def _noise_gain(
    blur: _Blur, variance: np.ndarray, gradient_square: np.ndarray, steps: int
) -> tuple[np.ndarray, np.ndarray]:
    """How noise reaches the phase: factor of the pixel's own variance, and variance from others times |Z|².

    Parameters
    ----------
    blur : _Blur
    variance : (rows, cols)
        Of the modulation, and alike of the phase times the modulation.
    gradient_square : (rows, cols)
        |∇Φ|², rad²/px².
    steps : int
        Of the brightness.
    """
    fy, fx = (2 * np.pi * fft.fftfreq(n) for n in blur.shape)
    average = np.exp(-0.5 * AVERAGE_SIGMA_PX**2 * (fy[:, None] ** 2 + fx**2)).astype(np.float32)
    v, u = (n * fft.fftfreq(n) for n in blur.shape)  # whole pixels

    def gathered(kernel: np.ndarray) -> np.ndarray:
        """Variance from around through an even kernel of squares."""
        return np.maximum(_convolved(variance, np.real(np.asarray(fft.fft2(kernel, workers=dr.thread_count())))), 0)

    own, others = (np.zeros(blur.shape, np.float32) for _ in range(2))
    for share, transfer in blur.layers:
        # The phase's steps are Φ <- measured + (1 - h) average Φ; the brightness's are L <- L + h (B - h L).
        passed, deconvolved = np.ones_like(transfer), np.ones_like(transfer)
        for _ in range(_PHASE_STEPS):
            passed = 1 + (1 - transfer) * average * passed
        for _ in range(steps):
            deconvolved = deconvolved + transfer * (1 - transfer * deconvolved)
        from_phase, spread = _kernel(passed), _kernel(transfer)
        own += share * from_phase[0, 0] ** 2
        from_phase[0, 0] = 0
        across, down = (
            _kernel(np.asarray(fft.fft2(spread * at, workers=dr.thread_count())) * deconvolved)
            for at in (u, v[:, None])
        )
        others += share * (gathered(from_phase**2) + gradient_square * gathered((across**2 + down**2) / 2))
    return own, others
