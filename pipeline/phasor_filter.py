"""The one filter there is: a plane fitted to the fringes' phasors under a Gaussian, applied only when asked for.

A plain mean of the phasors B exp(iΦ) under a Gaussian would draw the phase towards the brighter side where brightness
and phase both change, as the lens's blur does. So the unit phasors exp(iΦ) have the weights of their information,
1 / sigma², and a plane is fitted to them around each pixel, whose value there is taken: the phase of a plane stays what
it is under any brightness, and where brightness is even this is the plain mean under the Gaussian.

At borders and holes the neighbours lie on one side, and the plane is extrapolated to the pixel from there. That keeps
the phase of a plane, which a mean would draw inwards, but is noisier than in the middle; ``sigma`` says by how much.
The phase of a curved surface is continued along its tangent.

The weights are noisy, too: of neighbours that lie beside the plane they move its value. A modulation has the phase's
relative error, and the weight goes with its square. So a pixel of noise n and m, independent and both of variance
sigma², that lies by the angle ρ beside the plane there pulls by n cos ρ + 2 m sin ρ: at edges ``sigma`` has
1 + 3 sin² ρ times its variance. What ``sigma`` does not know is noise that decides whether a neighbour is valid at all,
next to edges and rims.

On an evenly bright surface the filter passes a wave of period p by exp(-2 (π s / p)²), with s the Gaussian's standard
deviation: half of it at p = π s √(2 / ln 2), 2.27 of its full widths at half maximum.
"""

from dataclasses import replace

import numpy as np

from greenough.instrument.errors import InputError

from .decode import PhaseMap
from .local_planes import LocalPlanes

_FWHM_PER_SIGMA = 2 * np.sqrt(2 * np.log(2))
_LEAST_SIGMA = 1e-3  # of the largest: keeps the weights of perfect frames finite


def filter_phasors(phase_map: PhaseMap, fwhm_px: float) -> PhaseMap:
    """Replace the phase by that of the plane fitted to the neighbouring phasors exp(iΦ) under a Gaussian.

    The phase's best-fitted linear course over the picture is taken out before and put back after: otherwise the fringes
    themselves would fade. No fringe order is changed, no invalid pixel is filled, and invalid pixels have no weight.

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
    if not valid.any():
        return phase_map
    course = linear_course(phase_map.absolute, valid)
    rest = np.where(valid, phase_map.absolute - course, 0.0)
    noise = np.where(valid, phase_map.sigma, 0.0).astype(np.float64)
    weight = np.where(valid, np.maximum(noise, _LEAST_SIGMA * noise.max() or 1.0) ** -2, 0.0)
    planes = LocalPlanes.under(weight, fwhm_px / _FWHM_PER_SIGMA)
    real, imaginary = planes.fit(np.cos(rest)), planes.fit(np.sin(rest))
    filtered = np.arctan2(imaginary, real)
    pull = 1 + 3 * np.sin(rest - filtered) ** 2
    filtered += 2 * np.pi * np.rint((rest - filtered) / (2 * np.pi))
    with np.errstate(divide="ignore", invalid="ignore"):
        sigma = np.sqrt(planes.variance(noise**2 * pull)) / np.hypot(real, imaginary)
    return replace(
        phase_map,
        absolute=np.where(valid, filtered + course, np.nan).astype(phase_map.absolute.dtype),
        sigma=np.where(valid, sigma, phase_map.sigma).astype(phase_map.sigma.dtype),
    )


def linear_course(absolute: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Best-fitted a + b u + c v of a phase map, (rows, cols)."""
    rows, cols = np.nonzero(valid)
    v, u = np.mgrid[: valid.shape[0], : valid.shape[1]]
    every = max(1, len(rows) // 100_000)
    rows, cols = rows[::every], cols[::every]
    design = np.stack([np.ones(len(rows)), cols, rows], axis=-1)
    a, b, c = np.linalg.lstsq(design, absolute[rows, cols].astype(np.float64), rcond=None)[0]
    return a + b * u + c * v
