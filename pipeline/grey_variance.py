"""How much a grey value scatters: an affine function of the light, from the camera's data sheet or from the frames."""

from dataclasses import dataclass
from math import inf

import numpy as np
from scipy.optimize import nnls

from greenough.instrument.contract import CameraNoise

from .blas import on_one_thread
from .fringes import FringeSet

QUANTISATION_VARIANCE = 1 / 12
"""Variance that rounding to whole grey values adds, DN²."""

_SAMPLE_PIXELS = 5_000  # with 12 degrees of freedom each, the variance is known to sqrt(2 / 60 000) = 0.6 %
_ASSUMED_NOISE = 0.01  # of the largest grey value, if frames without redundancy come without their noise


@dataclass(frozen=True, eq=False)
class GreyVariance:
    """Variance of a grey value that lies I DN above black: ``at_black_dn2 + per_dn * I``.

    Parameters
    ----------
    at_black_dn2 : float or (rows, cols)
        In the dark, DN².
    per_dn : float or (rows, cols)
        Increase by shot noise, DN² for each DN.
    """

    at_black_dn2: float | np.ndarray
    per_dn: float | np.ndarray

    def at(self, above_black_dn: np.ndarray) -> np.ndarray:
        """Variance in DN² of grey values; negative ones scatter as black does."""
        return self.at_black_dn2 + self.per_dn * np.maximum(above_black_dn, 0)


def camera_variance(noise: CameraNoise, quantised: bool) -> GreyVariance:
    """Variance of a grey value from the camera's data sheet.

    The electrons of I DN above black are Poisson distributed, so that the variance is I / g + (read / g)² with g
    electrons per DN, plus 1/12 DN² where grey values are whole numbers.
    """
    at_black = (noise.read_noise_e / noise.electrons_per_dn) ** 2
    return GreyVariance(at_black + (QUANTISATION_VARIANCE if quantised else 0.0), 1 / noise.electrons_per_dn)


@on_one_thread
def estimate_variance(
    stack: np.ndarray, fringes: FringeSet, black_dn: float = 0.0, full_scale_dn: float = inf
) -> GreyVariance:
    """Variance of a grey value from the frames alone.

    The N frames of a set have three unknowns per pixel, and what their fit leaves is noise, or harmonics if there are
    any. These raise ``per_dn``, mostly, as they grow with the light: the phases' sigma comes out too large, and weights
    of frames that are made from this variance become more unequal than the noise deserves, so that more of a second
    harmonic leaks into the phase. The residuals being P I with P the projection onto all else, the m-th has the
    variance Σ_n P_mn² (a + b I_n): a line in the light, as a photon transfer curve is. It is fitted to a regular sample
    of unsaturated pixels with both coefficients not negative.

    Where all sets have three steps nothing is left over; the noise is then taken to be 1 % of the largest grey value.
    """
    least = QUANTISATION_VARIANCE if stack.dtype.kind == "u" else 0.0
    stride = max(1, int(np.sqrt(stack[0].size / _SAMPLE_PIXELS)))
    sample = stack[:, ::stride, ::stride].reshape(len(stack), -1).astype(np.float64)  # (frames, pixels)
    sample = sample[:, (sample < full_scale_dn).all(axis=0)]
    if max(fringes.steps) == 3 or sample.size == 0:
        return GreyVariance((_ASSUMED_NOISE * float(sample.max(initial=0.0))) ** 2 + least, 0.0)
    squares, constant, slope = [], [], []
    for part, steps in zip(fringes.slices, fringes.steps, strict=True):
        angle = 2 * np.pi * np.arange(steps) / steps
        fringe = np.stack([np.ones(steps), np.cos(angle), np.sin(angle)], axis=-1)
        fit = fringe @ np.linalg.pinv(fringe)  # (N, N)
        unexplained = np.eye(steps) - fit
        light = np.maximum(fit @ sample[part] - black_dn, 0)
        squares.append(np.square(unexplained @ sample[part]))
        constant.append(np.square(unexplained) @ np.ones_like(light))
        slope.append(np.square(unexplained) @ light)
    line = np.stack([np.concatenate(column).ravel() for column in (constant, slope)], axis=-1)
    (at_black, per_dn), _ = nnls(line, np.concatenate(squares).ravel() - least * line[:, 0])
    return GreyVariance(least + float(at_black), float(per_dn))
