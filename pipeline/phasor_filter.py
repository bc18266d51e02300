"""The one filter there is: a Gaussian on the fringes' phasors, applied only when asked for."""

from dataclasses import replace

import cv2
import numpy as np

from greenough.instrument.errors import InputError

from .decode import PhaseMap

_FWHM_PER_SIGMA = 2 * np.sqrt(2 * np.log(2))
_REACH = 4.0  # sigmas


def filter_phasors(phase_map: PhaseMap, fwhm_px: float) -> PhaseMap:
    """Replace the phase by that of the Gaussian-weighted mean of the neighbouring phasors B exp(iΦ).

    The phase's best-fitted linear course over the picture is taken out before and put back after: otherwise the fringes
    themselves would fade, and a pixel beside invalid ones would take the phase of the middle of its valid neighbours.
    No fringe order is changed, no invalid pixel is filled, and invalid pixels have no weight.

    Parameters
    ----------
    phase_map : PhaseMap
    fwhm_px : float
        Full width at half maximum of the Gaussian in pixels, at most a tenth of the picture.

    Returns
    -------
    PhaseMap
        With ``absolute`` and ``sigma`` of the filtered phasors; the rest as it was.

    Raises
    ------
    InputError
        If the width is not in range.
    """
    widest = min(phase_map.valid.shape) / 10
    if not 0 < fwhm_px <= widest:
        raise InputError(f"the filter's width is {fwhm_px:g} px: it must be above 0 and at most {widest:g} px")
    valid = phase_map.valid
    kernel = _gaussian(fwhm_px / _FWHM_PER_SIGMA)
    carrier = linear_course(phase_map.absolute, valid)
    rest = np.where(valid, phase_map.absolute - carrier, 0.0)
    amplitude = np.where(valid, phase_map.modulation, 0.0).astype(np.float64)
    real, imaginary = _smooth(amplitude * np.cos(rest), kernel), _smooth(amplitude * np.sin(rest), kernel)
    filtered = np.arctan2(imaginary, real)
    filtered += 2 * np.pi * np.rint((rest - filtered) / (2 * np.pi))
    # Independent noise: the phasors' noise B sigma adds up in quadrature under the kernel.
    noise = _smooth((amplitude * np.where(valid, phase_map.sigma, 0.0)) ** 2, kernel**2)
    with np.errstate(divide="ignore", invalid="ignore"):
        sigma = np.where(valid, np.sqrt(noise) / np.hypot(real, imaginary), phase_map.sigma)
    return replace(
        phase_map,
        absolute=np.where(valid, filtered + carrier, np.nan).astype(phase_map.absolute.dtype),
        sigma=sigma.astype(phase_map.sigma.dtype),
    )


def _gaussian(sigma: float) -> np.ndarray:
    reach = int(np.ceil(_REACH * sigma))
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    return kernel / kernel.sum()


def _smooth(image: np.ndarray, kernel: np.ndarray) -> np.ndarray:
    return cv2.sepFilter2D(image, cv2.CV_64F, kernel, kernel, borderType=cv2.BORDER_CONSTANT)


def linear_course(absolute: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Best-fitted a + b u + c v of a phase map, (rows, cols)."""
    rows, cols = np.nonzero(valid)
    v, u = np.mgrid[: valid.shape[0], : valid.shape[1]]
    every = max(1, len(rows) // 100_000)
    rows, cols = rows[::every], cols[::every]
    design = np.stack([np.ones(len(rows)), cols, rows], axis=-1)
    a, b, c = np.linalg.lstsq(design, absolute[rows, cols].astype(np.float64), rcond=None)[0]
    return a + b * u + c * v
