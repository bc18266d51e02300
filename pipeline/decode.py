"""From frames to absolute phase: the paper's eq. 2-5 as one kernel.

Grey values are in DN. The frames of a set are I_n = A + B cos(Φ + 2π n / N).
"""

from dataclasses import dataclass
from math import cos, inf, pi, sin

import numpy as np
from scipy.optimize import nnls

from greenough.instrument.contract import CameraNoise, Frames
from greenough.instrument.errors import InputError
from greenough.instrument.llvm import ensure_llvm

from .fringes import FringeSet
from .unwrap import RESIDUAL_LIMIT, order_is_safe, unwrap

ensure_llvm()  # Dr.Jit looks for LLVM while it is imported

import drjit as dr  # noqa: E402  must follow ensure_llvm
from drjit.llvm import Bool, Float, UInt8  # noqa: E402  must follow ensure_llvm

QUANTISATION_VARIANCE = 1 / 12
"""Variance that rounding to whole grey values adds, DN²."""

_SAMPLE_PIXELS = 5_000  # with 12 degrees of freedom each, the variance is known to sqrt(2 / 60 000) = 0.6 %
_ASSUMED_NOISE = 0.01  # of the largest grey value, if frames without redundancy come without their noise


@dataclass(frozen=True)
class PhaseMap:
    """What a fringe sequence says about each pixel. All arrays are (rows, cols).

    Parameters
    ----------
    absolute : float32
        Absolute phase Φ of the densest set, rad; NaN where not valid.
    modulation : float32
        Modulation B of the densest set, DN (eq. 4).
    background : float32
        Background A above the black level, DN: the mean of all frames (eq. 3).
    valid : bool
        Neither saturated nor too weakly modulated for a safe fringe order, fringe-order residual within
        ``unwrap.RESIDUAL_LIMIT``, and not left ambiguous by the wrap of the coarsest set.
    residual : float32
        Fringe-order residual of the step of the chain where it is largest, rad.
    sigma : float32
        Standard deviation of ``absolute`` that the noise predicts, sqrt(2/N) σ / B, rad.
    """

    absolute: np.ndarray
    modulation: np.ndarray
    background: np.ndarray
    valid: np.ndarray
    residual: np.ndarray
    sigma: np.ndarray


def decode(frames: Frames | np.ndarray, fringes: FringeSet, noise: CameraNoise | np.ndarray | None = None) -> PhaseMap:
    """Decode one sequence of phase-shifted frames.

    Parameters
    ----------
    frames : Frames, or (frames, rows, cols) uint8, uint16 or float
        One frame per pattern of ``fringes``, in its order. A bare array has black level 0 and clips at its type's
        largest value; floats do not clip.
    fringes : FringeSet
        What was projected.
    noise : CameraNoise, (rows, cols) array, or None
        The camera's noise, or the variance of a single grey value at each pixel in DN². If None, it is estimated from
        what the frames themselves leave unexplained (`estimate_variance`).

    Raises
    ------
    InputError
        If the stack's count, shape or type does not fit.
    """
    stack, black_dn, full_scale_dn = _grey_values(frames, fringes)
    shape = stack.shape[1:]

    # The kernel is compiled once per fringe set: what varies from call to call is opaque to it.
    black, full_scale = dr.opaque(Float, black_dn), dr.opaque(Float, full_scale_dn)
    grey = [Float(UInt8(frame.ravel()) if stack.dtype == np.uint8 else Float(frame.ravel())) for frame in stack]
    background = sum(grey[1:], grey[0]) / len(grey) - black
    if isinstance(noise, np.ndarray):
        if noise.shape != shape:
            raise InputError(f"noise variance: its shape {noise.shape} must be that of a frame, {shape}.")
        variance = Float(np.ascontiguousarray(noise, dtype=np.float32).ravel())
    else:
        if noise is None:
            at_black, per_dn = estimate_variance(stack, fringes, black_dn, full_scale_dn)
        else:
            at_black, per_dn = camera_variance(noise, quantised=stack.dtype.kind == "u")
        variance = dr.opaque(Float, at_black) + dr.opaque(Float, per_dn) * dr.maximum(background, 0)

    phases, modulations, phase_variances = [], [], []
    for part, steps in zip(fringes.slices, fringes.steps, strict=True):
        phase, modulation = _wrapped_phase(grey[part])
        phases.append(phase)
        modulations.append(modulation)
        phase_variances.append(2 / steps * variance / dr.square(modulation))

    unwrapped = unwrap(phases, phase_variances, fringes)
    brightest = grey[0]
    for values in grey[1:]:
        brightest = dr.maximum(brightest, values)
    valid: Bool = (
        unwrapped.resolved
        & (dr.abs(unwrapped.residual) < RESIDUAL_LIMIT)
        & order_is_safe(phase_variances, fringes)
        & (brightest < full_scale)
    )
    absolute = dr.select(valid, unwrapped.absolute, dr.nan)
    sigma = dr.sqrt(phase_variances[-1])
    results = (absolute, modulations[-1], background, valid, unwrapped.residual, sigma)
    dr.eval(*results)
    return PhaseMap(*(np.array(result).reshape(shape) for result in results))


def camera_variance(noise: CameraNoise, quantised: bool) -> tuple[float, float]:
    """Variance of a grey value, as (at black in DN², per DN above black in DN), from the camera's data sheet.

    The electrons of I DN above black are Poisson distributed, so that the variance is I / g + (read / g)² with g
    electrons per DN, plus 1/12 DN² where grey values are whole numbers.
    """
    at_black = (noise.read_noise_e / noise.electrons_per_dn) ** 2
    return at_black + (QUANTISATION_VARIANCE if quantised else 0.0), 1 / noise.electrons_per_dn


def estimate_variance(
    stack: np.ndarray, fringes: FringeSet, black_dn: float = 0.0, full_scale_dn: float = inf
) -> tuple[float, float]:
    """Variance of a grey value, as (at black in DN², per DN above black in DN), from the frames alone.

    The N frames of a set have three unknowns per pixel; the other N - 3 degrees of freedom hold noise, and harmonics
    if there are any, which errs on the safe side. Their mean square over a regular sample of unsaturated pixels is
    fitted by a line in the background with both coefficients not negative, as a photon transfer curve is.

    Where all sets have three steps nothing is left over; the noise is then taken to be 1 % of the largest grey value.
    """
    least = QUANTISATION_VARIANCE if stack.dtype.kind == "u" else 0.0
    stride = max(1, int(np.sqrt(stack[0].size / _SAMPLE_PIXELS)))
    sample = stack[:, ::stride, ::stride].reshape(len(stack), -1).astype(np.float64)  # (frames, pixels)
    sample = sample[:, (sample < full_scale_dn).all(axis=0)]
    freedom = sum(steps - 3 for steps in fringes.steps)
    if freedom == 0 or sample.size == 0:
        return (_ASSUMED_NOISE * float(sample.max(initial=0.0))) ** 2 + least, 0.0
    unexplained = np.zeros(sample.shape[1])
    for part, steps in zip(fringes.slices, fringes.steps, strict=True):
        grey = sample[part] - sample[part].mean(axis=0)
        angle = 2 * np.pi * np.arange(steps)[:, None] / steps
        sine, cosine = (np.sin(angle) * grey).sum(axis=0), (np.cos(angle) * grey).sum(axis=0)
        unexplained += np.square(grey).sum(axis=0) - 2 / steps * (np.square(sine) + np.square(cosine))
    line = np.stack([np.ones(sample.shape[1]), np.maximum(sample.mean(axis=0) - black_dn, 0)], axis=-1)
    (at_black, per_dn), _ = nnls(line, unexplained / freedom - least)
    return least + float(at_black), float(per_dn)


def _grey_values(frames: Frames | np.ndarray, fringes: FringeSet) -> tuple[np.ndarray, float, float]:
    """Stack as uint8 or float32 with contiguous frames, black level and full scale; InputError if it does not fit."""
    stack = frames.stack if isinstance(frames, Frames) else np.asarray(frames)
    if stack.ndim != 3 or 0 in stack.shape:
        raise InputError(f"frame stack: its shape {stack.shape} must be (frames, rows, cols) with none of them 0.")
    if len(stack) != fringes.frame_count:
        raise InputError(
            f"frame stack: it holds {len(stack)} frames but the fringe set with steps {fringes.steps} needs "
            f"{fringes.frame_count}."
        )
    if stack.dtype not in (np.uint8, np.uint16, np.float32, np.float64):
        raise InputError(f"frame stack: its type {stack.dtype} must be uint8, uint16, float32 or float64.")
    if isinstance(frames, Frames):
        black_dn, full_scale_dn = frames.black_level_dn, frames.full_scale_dn
    else:
        black_dn, full_scale_dn = 0.0, float(np.iinfo(stack.dtype).max) if stack.dtype.kind == "u" else inf
    return np.ascontiguousarray(stack), float(black_dn), float(full_scale_dn)


def _wrapped_phase(grey: list[Float]) -> tuple[Float, Float]:
    """Wrapped phase in rad (eq. 2) and modulation in DN (eq. 4) of one set."""
    steps = len(grey)
    sine, cosine = Float(0), Float(0)
    for n, values in enumerate(grey):
        sine += values * sin(2 * pi * n / steps)
        cosine += values * cos(2 * pi * n / steps)
    return -dr.atan2(sine, cosine), 2 / steps * dr.sqrt(dr.square(sine) + dr.square(cosine))
