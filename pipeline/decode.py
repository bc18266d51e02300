"""From frames to absolute phase: the paper's eq. 2-5 as one kernel, with eq. 2 weighted by the noise.

Grey values are in DN. The frames of a set are I_n = A + B cos(Φ + 2π n / N).
"""

from dataclasses import dataclass
from math import inf
from typing import TYPE_CHECKING, Any

import numpy as np

from greenough.instrument.contract import CameraNoise, Frames
from greenough.instrument.errors import InputError
from greenough.instrument.packets import packed

from .fringes import FringeSet
from .grey_variance import GreyVariance, camera_variance, estimate_variance
from .jit import Array2u8, Bool, Float, UInt8, UInt32, dr
from .order_search import ColumnWindow, check_orders, search_order
from .phase_shifting import estimate_phasor
from .unwrap import RESIDUAL_LIMIT, is_modulated, order_is_safe, unwrap

if TYPE_CHECKING:
    from xarray import Dataset


@dataclass(frozen=True)
class PhaseMap:
    """What a fringe sequence says about each pixel. All arrays are (rows, cols).

    Parameters
    ----------
    absolute : float32
        Absolute phase Φ of the densest set, rad; NaN where not valid.
    modulation : float32
        Modulation B of the densest set, DN (eq. 4), as exact as the phase: its relative error is ``sigma`` too.
    background : float32
        Background A above the black level, DN: the mean of all frames (eq. 3).
    valid : bool
        Neither saturated nor too weakly modulated for a safe fringe order, fringe-order residual within
        ``unwrap.RESIDUAL_LIMIT``, and not left ambiguous by the wrap of the coarsest set.
    residual : float32
        Fringe-order residual of the step of the chain where it is largest, rad.
    sigma : float32
        Standard deviation of ``absolute`` that the noise predicts, rad: sqrt(2/N) σ / B, with σ² the variance of a
        grey value as bright as the background, less what the weights gain (`phase_shifting`).
    exposures : int
        How many the run had taken after these frames, by which drifts may have grown; 0 where nobody counted.
    """

    absolute: np.ndarray
    modulation: np.ndarray
    background: np.ndarray
    valid: np.ndarray
    residual: np.ndarray
    sigma: np.ndarray
    exposures: int = 0

    def to_xarray(self) -> "Dataset":
        """See `datasets.phase_map_dataset`."""
        from .datasets import phase_map_dataset

        return phase_map_dataset(self)

    def _repr_html_(self) -> str:
        from .notebook import phase_map_html

        return phase_map_html(self)


def decode(
    frames: Frames | np.ndarray,
    fringes: FringeSet,
    noise: CameraNoise | GreyVariance | None = None,
    window: ColumnWindow | None = None,
) -> PhaseMap:
    """Decode one sequence of phase-shifted frames.

    Parameters
    ----------
    frames : Frames, or (frames, rows, cols) uint8, uint16 or float
        One frame per pattern of ``fringes``, in its order. A bare array has black level 0 and clips at its type's
        largest value; floats do not clip.
    fringes : FringeSet
        What was projected.
    noise : CameraNoise, GreyVariance, or None
        The camera's data sheet, or the variance of grey values that are no single exposures. If None, it is estimated
        from what the frames themselves leave unexplained (`estimate_variance`).
    window : ColumnWindow, optional
        What else is known of where each pixel is, a Gray code for example (`gray_code.locate`).

    Raises
    ------
    InputError
        If the stack's count, shape or type does not fit, a variance has another shape, or fringe orders cannot be
        told by this set.
    """
    by_search = window is not None or not fringes.spans_field
    if by_search:
        check_orders(fringes, window)
    stack, black_dn, full_scale_dn = _grey_values(frames, fringes)
    shape = stack.shape[1:]
    if noise is None:
        noise = estimate_variance(stack, fringes, black_dn, full_scale_dn)
    elif isinstance(noise, CameraNoise):
        noise = camera_variance(noise, quantised=stack.dtype.kind == "u")

    # The kernel is compiled once per fringe set: what varies from call to call is opaque to it. It is traced in every
    # call, since replaying it (`drjit.freeze`) from two threads at a time ends the process.
    black, full_scale = dr.opaque(Float, black_dn), dr.opaque(Float, full_scale_dn)
    per_dn = _per_pixel(noise.per_dn, shape)
    as_captured: list[Any] = [_mapped(frame) for frame in stack]  # the stubs allow nothing to be done to a union
    grey = [Float(frame) for frame in as_captured]
    background = _sum(grey) / len(grey) - black
    variance = _per_pixel(noise.at_black_dn2, shape) + per_dn * dr.maximum(background, 0)
    sets = [grey[part] for part in fringes.slices]
    if fringes.sign < 0:
        sets = [[frames_of_set[0], *frames_of_set[:0:-1]] for frames_of_set in sets]
    phasors = [estimate_phasor(frames_of_set, variance, per_dn) for frames_of_set in sets]
    phases, phase_variances = [each.phase - fringes.start for each in phasors], [each.variance for each in phasors]
    if by_search:
        near = (_per_pixel(window.centre, shape), _per_pixel(window.half_width, shape)) if window else None
        unwrapped = search_order(phases, phase_variances, fringes, near)
        safe = is_modulated(phase_variances)
    else:
        unwrapped = unwrap(phases, phase_variances, fringes)
        safe = order_is_safe(phase_variances, fringes)
    # Bytes are compared faster than what is made of them, but CUDA has no instruction for bytes.
    compared = as_captured if dr.backend_v(Float) == dr.JitBackend.LLVM else grey
    brightest = compared[0]
    for values in compared[1:]:
        brightest = dr.maximum(brightest, values)
    valid: Bool = (
        unwrapped.resolved & (dr.abs(unwrapped.residual) < RESIDUAL_LIMIT) & safe & (Float(brightest) < full_scale)
    )
    absolute = dr.select(valid, unwrapped.absolute, dr.nan)
    sigma = dr.sqrt(phase_variances[-1])
    results = (absolute, phasors[-1].modulation, background, valid, unwrapped.residual, sigma)
    dr.eval(*results)
    exposures = int(frames.serials[-1]) + 1 if isinstance(frames, Frames) else 0
    return PhaseMap(*(result.numpy().reshape(shape) for result in results), exposures=exposures)


def _mapped(frame: np.ndarray) -> UInt8 | Float:
    """Grey values (pixels,) that the CPU reads where the frame lies, unless it is of float64."""
    if frame.dtype == np.uint8:
        return UInt8(packed(frame))
    if frame.dtype == np.uint16:  # which Dr.Jit has not: it reads their bytes, the low one first
        low, high = dr.gather(Array2u8, UInt8(packed(frame.view(np.uint8))), dr.arange(UInt32, frame.size))
        return Float(low) + 256 * Float(high)
    return Float(packed(frame))


def _sum(values: list[Float]) -> Float:
    """Of neighbours first, then of their sums: no addition waits for all others before it."""
    while len(values) > 1:
        values = [sum(values[k + 1 : k + 2], values[k]) for k in range(0, len(values), 2)]
    return values[0]


def _grey_values(frames: Frames | np.ndarray, fringes: FringeSet) -> tuple[np.ndarray, float, float]:
    """Stack as uint8 or float32 with contiguous frames, black level and full scale; InputError if it does not fit."""
    stack = frames.stack if isinstance(frames, Frames) else np.asarray(frames)
    if stack.ndim != 3 or 0 in stack.shape:
        raise InputError(f"frame stack: its shape {stack.shape} must be (frames, rows, cols) with none of them 0")
    if len(stack) != fringes.frame_count:
        raise InputError(
            f"frame stack: it holds {len(stack)} frames but the fringe set with steps {fringes.steps} needs "
            f"{fringes.frame_count}"
        )
    if stack.dtype not in (np.uint8, np.uint16, np.float32, np.float64):
        raise InputError(f"frame stack: its type {stack.dtype} must be uint8, uint16, float32 or float64")
    if isinstance(frames, Frames):
        black_dn, full_scale_dn = frames.black_level_dn, frames.full_scale_dn
    else:
        black_dn, full_scale_dn = 0.0, float(np.iinfo(stack.dtype).max) if stack.dtype.kind == "u" else inf
    return np.ascontiguousarray(stack), float(black_dn), float(full_scale_dn)


def _per_pixel(value: float | np.ndarray, shape: tuple[int, ...]) -> Float:
    """A number for all pixels, or one for each; InputError if these are not as many as a frame has."""
    if not isinstance(value, np.ndarray):
        return dr.opaque(Float, value)
    if value.shape != shape:
        raise InputError(f"noise variance or column window: its shape {value.shape} must be that of a frame, {shape}")
    return Float(packed(value.astype(np.float32, copy=False)))
