"""How exactly a phase can be known at best: the bound of Cramér and Rao for N shifted fringe frames.

A grey value is a Poisson distributed number of electrons, plus normal read noise, in DN, and rounded where the camera
does that. What one such value tells about the light is its Fisher information, summed up here from the exact
probabilities P(grey value | light):

    J(I) = Σ (dP/dI)² / P.

It is a little more than the reciprocal of the variance, 1 / (a + b I), of which normal noise of known variance is left.
From frames I_n = A + B cos(φ + 2π n / N) with A, B and φ unknown, the information is Σ J(I_n) s_n s_nᵀ with the slopes
s_n of I_n in A, B and φ, and no unbiased estimate of φ has a lower variance than this matrix's inverse says.
"""

from collections.abc import Callable

import numpy as np
from scipy.special import ndtr
from scipy.stats import poisson

from greenough.instrument.contract import CameraNoise

_REACH = 9.0  # standard deviations, beyond which nothing is told
_FINE = 0.25  # of the read noise: width of the bins that stand for a grey value that is not rounded
_LEAST_PROBABILITY = 1e-13  # below, rounding errors of the sums would count


def grey_information(light_dn: np.ndarray, noise: CameraNoise, quantised: bool) -> np.ndarray:
    """Fisher information of one grey value on the light, (n,) DN^-2.

    Parameters
    ----------
    light_dn : (n,)
        Light above black, DN; positive.
    noise : CameraNoise
        With a read noise above 0.
    quantised : bool
        Whether grey values are whole numbers; the light's own whole numbers are black.
    """
    return np.array([_information(float(light), noise, quantised) for light in light_dn])


def _information(light_dn: float, noise: CameraNoise, quantised: bool) -> float:
    per_dn, read = noise.electrons_per_dn, noise.read_noise_e
    mean = light_dn * per_dn
    reach = _REACH * np.sqrt(mean)
    electrons = np.arange(max(0, int(mean - reach)), int(mean + reach + _REACH**2) + 1)
    chance = poisson.pmf(electrons, mean)
    change = chance * (electrons / mean - 1) * per_dn  # dP/dI
    width = per_dn if quantised else _FINE * read  # electrons
    first, last = (electrons[0] - _REACH * read) / width, (electrons[-1] + _REACH * read) / width
    edges = (np.arange(np.floor(first), np.ceil(last) + 2) - 0.5) * width
    within = np.diff(ndtr((edges[:, None] - electrons) / read), axis=0)  # (bins, electrons)
    probability, slope = within @ chance, within @ change
    likely = probability > _LEAST_PROBABILITY
    return float(np.sum(slope[likely] ** 2 / probability[likely]))


def phase_bound(
    background: np.ndarray,
    modulation: np.ndarray,
    phase: np.ndarray,
    steps: int,
    information: Callable[[np.ndarray], np.ndarray],
) -> np.ndarray:
    """Least variance of an unbiased estimate of φ, (n,) rad².

    Parameters
    ----------
    background, modulation, phase : (n,)
        A above black and B in DN, φ in rad.
    steps : int
        N.
    information : callable
        What a grey value of light I above black, DN, tells about I, DN^-2: `grey_information`, interpolated, or the
        reciprocal of a variance.
    """
    angle = np.asarray(phase)[:, None] + 2 * np.pi * np.arange(steps) / steps
    cosine, sine = np.cos(angle), np.sin(angle)
    known = information(np.asarray(background)[:, None] + np.asarray(modulation)[:, None] * cosine)  # (n, N)
    slopes = np.stack([np.ones_like(angle), cosine, -np.asarray(modulation)[:, None] * sine], axis=-1)
    return np.linalg.inv(np.einsum("pn,pni,pnj->pij", known, slopes, slopes))[:, 2, 2]
