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

    The N frames of a set have three unknowns per pixel. What their fit leaves is noise, and harmonics if there are any;
    but harmonics are alike in neighbouring pixels, along the fringes above all, and noise is not. So residuals of
    neighbours are subtracted, once down the rows and once along them, and what scatters less is taken. The residuals
    being P I with P the projection onto all else, half the square of the m-th difference has the mean
    Σ_n P_mn² (a + b I_n): a line in the light, as a photon transfer curve is. It is fitted to a regular sample of
    unsaturated pixels with both coefficients not negative.

    Where all sets have three steps nothing is left over; the noise is then taken to be 1 % of the largest grey value.
    """
    pairs = [_neighbours(stack, axis, full_scale_dn) for axis in (1, 2) if stack.shape[axis] > 1]
    pairs = [(here, there) for here, there in pairs if here.size]
    brightest = max((float(here.max()) for here, _ in pairs), default=0.0)
    # Floats are decoded in single precision.
    least = QUANTISATION_VARIANCE if stack.dtype.kind == "u" else float(np.finfo(np.float32).eps * brightest) ** 2
    if max(fringes.steps) == 3 or not pairs:
        return GreyVariance((_ASSUMED_NOISE * brightest) ** 2 + least, 0.0)
    here, there = min(pairs, key=lambda pair: _scatter(*pair, fringes))
    squares, constant, slope = [], [], []
    for part, steps in zip(fringes.slices, fringes.steps, strict=True):
        fit = _fringe_fit(steps)
        unexplained = np.eye(steps) - fit
        light = np.maximum(fit @ (here[part] + there[part]) / 2 - black_dn, 0)
        squares.append(np.square(unexplained @ (here[part] - there[part])) / 2)
        constant.append(np.square(unexplained) @ np.ones_like(light))
        slope.append(np.square(unexplained) @ light)
    line = np.stack([np.concatenate(column).ravel() for column in (constant, slope)], axis=-1)
    (at_black, per_dn), _ = nnls(line, np.concatenate(squares).ravel() - least * line[:, 0])
    return GreyVariance(least + float(at_black), float(per_dn))


def _neighbours(stack: np.ndarray, axis: int, full_scale_dn: float) -> tuple[np.ndarray, np.ndarray]:
    """A regular sample of pixels and of the next ones along an axis, neither saturated, each (frames, pixels)."""
    stride = max(1, int(np.sqrt(stack[0].size / _SAMPLE_PIXELS)))
    rows, cols = stack.shape[1] - (axis == 1), stack.shape[2] - (axis == 2)
    here = stack[:, :rows:stride, :cols:stride].reshape(len(stack), -1).astype(np.float64)
    there = stack[:, stack.shape[1] - rows :: stride, stack.shape[2] - cols :: stride]
    there = there.reshape(len(stack), -1).astype(np.float64)
    sound = ((here < full_scale_dn) & (there < full_scale_dn)).all(axis=0)
    return here[:, sound], there[:, sound]


def _scatter(here: np.ndarray, there: np.ndarray, fringes: FringeSet) -> float:
    """Mean square of what no fringes explain of the difference."""
    parts = zip(fringes.slices, fringes.steps, strict=True)
    apart = [(np.eye(steps) - _fringe_fit(steps)) @ (here[part] - there[part]) for part, steps in parts]
    return float(np.mean(np.square(np.concatenate(apart))))


def _fringe_fit(steps: int) -> np.ndarray:
    """Projection of N frames onto fringes and a background, (N, N)."""
    angle = 2 * np.pi * np.arange(steps) / steps
    fringe = np.stack([np.ones(steps), np.cos(angle), np.sin(angle)], axis=-1)
    return fringe @ np.linalg.pinv(fringe)
