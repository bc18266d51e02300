"""The fit of eq. 17 to planes at known heights, for many pixels at once: each pixel is a lane of the same kernels.

The planes are gone through six times, and what is needed of them is added up on the way: their extent, the normal
equations of eq. 19, those of two Gauss-Newton steps, whether all keep to the relation, and the residuals.

Single precision rounds heights to 0.1 nm, and normal equations lose little by it while the columns of the Jacobian have
directions of their own. Where a pixel saw a few planes at one end alone, w³ is all but a sum of the others: pixels
whose columns have less than ``LEAST_SHARE`` of their own are fitted again in double precision.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from greenough.instrument.packets import packed

from .jit import Bool, Float, Float64, UInt32, dr

LEAST_SHARE = 1e-2
"""Of a column's square: what single precision must find that the columns before it lack."""

_REFINEMENTS = 2
_LEAST_PIVOT = 1e-10  # the same share, of anything to be solved
_PLANES_AT_ONCE = 32  # of which a kernel is made: it takes longer to compile with every one

Real = Any
"""Float or Float64, the same throughout a fit; of either, Dr.Jit's stubs know no selection between value and number."""

Plane = tuple[Real, Real]
"""Phase of every pixel, and the height."""


@dataclass(frozen=True, eq=False)
class PixelFits:
    """Fits of ``n`` pixels; NaN where a pixel is not fitted.

    Parameters
    ----------
    coefficients : (4, n) float32
        m1, m0, n1 and r3 of the normalised phase.
    centre, half_range : (n,) float32
        Of the pixel's phases, rad: they normalise.
    z_range : (2, n) float32
        Lowest and highest height, mm.
    rms_mm : (n,) float32
        Of the residuals, fitted minus stated height.
    residual_sum_mm : (planes,) float64
        Residuals of each plane, added up over the fitted pixels.
    residual_count : (planes,) int
        How many these are.
    """

    coefficients: np.ndarray
    centre: np.ndarray
    half_range: np.ndarray
    z_range: np.ndarray
    rms_mm: np.ndarray
    residual_sum_mm: np.ndarray
    residual_count: np.ndarray


def fit_pixels(phases: Sequence[np.ndarray], z_mm: np.ndarray, min_planes: int, misfit_rad: float) -> PixelFits:
    """Fit every pixel by itself.

    Parameters
    ----------
    phases : sequence of (n,) float32 or float64
        Absolute phase in each plane, rad, NaN where invalid. Those of float64 are fitted in double precision.
    z_mm : (planes,)
    min_planes : int
        In which a pixel must be valid to be fitted.
    misfit_rad : float
        By less than which every plane must keep to a pixel's relation; a pixel that fails is not fitted.
    """
    if phases[0].dtype == np.float64:
        return _fit(Float64, phases, z_mm, min_planes, misfit_rad)[0]
    fits, weak = _fit(Float, phases, z_mm, min_planes, misfit_rad)
    if not weak.any():
        return fits
    again, _ = _fit(Float64, [phase[weak].astype(float) for phase in phases], z_mm, min_planes, misfit_rad)
    for name in ("coefficients", "centre", "half_range", "z_range", "rms_mm"):
        getattr(fits, name)[..., weak] = getattr(again, name)
    for name in ("residual_sum_mm", "residual_count"):
        getattr(fits, name)[:] += getattr(again, name)
    return fits


def _fit(
    real: type[Real], phases: Sequence[np.ndarray], z_mm: np.ndarray, min_planes: int, misfit_rad: float
) -> tuple[PixelFits, np.ndarray]:
    """Fits in one precision, and which pixels (n,) are left out for want of it: none in double precision."""
    planes = [(real(packed(phase)), dr.opaque(real, z)) for phase, z in zip(phases, z_mm, strict=True)]
    extent = _extent_of(planes)
    usable = (extent.count >= min_planes) & (extent.high > extent.low)
    # The stored numbers are float32: normalise with exactly what will be stored.
    centre = Float(dr.select(usable, (extent.low + extent.high) / 2, 0))
    half_range = Float(dr.select(usable, (extent.high - extent.low) / 2, 1))
    middle, per_rad = real(centre), 1 / real(half_range)
    dr.eval(usable, middle, per_rad)

    def normalised(phase: Real) -> tuple[Bool, Real]:
        """Which phases count, and what they are between the ends of their range; 0 if they do not count."""
        counts = dr.isfinite(phase) & usable
        return counts, dr.select(counts, (phase - middle) * per_rad, 0)

    def eq_19(phase: Real, z: Real) -> tuple[list[Real], Real]:
        """m1 t - n1 t z + m0 = z."""
        counts, t = normalised(phase)
        one = dr.select(counts, real(1), 0)
        return [t, one, -t * z], one * z

    def eq_18(m1: Real, m0: Real, n1: Real, r3: Real, phase: Real, z: Real) -> tuple[list[Real], Real]:
        """Height by steps of the four coefficients: what is missing to the stated one."""
        counts, t = normalised(phase)
        inverse = 1 / (n1 * t + 1)
        w = (m1 * t + m0) * inverse
        cube = w * w * w
        slope = dr.select(counts, (1 + 3 * r3 * w * w) * inverse, 0)  # dz/dw times dw/d(numerator)
        return [slope * t, slope, -slope * t * w, dr.select(counts, cube, 0)], z - w - r3 * cube

    start, _ = _least_squares(planes, eq_19, 3)
    coefficients, weak = [*start, dr.zeros(real, len(phases[0]))], Bool(False)
    dr.eval(*coefficients)
    for _ in range(_REFINEMENTS):
        steps, share = _least_squares(planes, partial(eq_18, *coefficients), 4)
        coefficients = [value + step for value, step in zip(coefficients, steps, strict=True)]
        if real is Float:
            weak |= usable & ~(share > LEAST_SHARE)  # also where it is NaN
        dr.eval(*coefficients, weak)

    def residual_of(phase: Real, z: Real) -> tuple[Bool, Real]:
        """Which residuals, fitted minus stated height, count; and all of them."""
        counts, t = normalised(phase)
        m1, m0, n1, r3 = coefficients
        w = (m1 * t + m0) / (n1 * t + 1)
        return counts, w + r3 * w * w * w - z

    limit = misfit_rad * (extent.z_high - extent.z_low) / 2 * per_rad

    def judged(astray: Bool, squares: Real, phase: Real, z: Real) -> list[Bool | Real]:
        counts, residual = residual_of(phase, z)
        near = dr.abs(residual) < limit  # not where it is NaN
        return [astray | (counts & ~near), squares + dr.select(counts, residual * residual, 0)]

    astray, squares = _folded(planes, judged, [Bool(False), real(0)])
    good = usable & ~astray & ~weak
    rms = dr.sqrt(squares / real(extent.count))
    values = [*coefficients, centre, half_range, extent.z_low, extent.z_high, rms]
    results = [Float(dr.select(good, value, dr.nan)) for value in values]
    dr.eval(good, weak, *results)
    sums, counted = _residual_sums(planes, good, residual_of)
    table = np.array([np.array(result) for result in results])
    fits = PixelFits(table[:4], table[4], table[5], table[6:8], table[8], sums, counted)
    return fits, np.array(weak)


@dataclass(frozen=True, eq=False)
class _Extent:
    """Of each pixel over the planes in which it has a phase."""

    count: UInt32
    low: Real  # phase, rad
    high: Real
    z_low: Real
    z_high: Real


def _folded(planes: Sequence[Plane], step: Callable[..., list], state: list) -> list:
    """``state = step(*state, phase, z)`` for one plane after the other."""
    for k, plane in enumerate(planes, 1):
        state = step(*state, *plane)
        if k % _PLANES_AT_ONCE == 0:
            dr.eval(*state)
    return state


def _extent_of(planes: Sequence[Plane]) -> _Extent:
    # Comparisons instead of minimum and maximum, for which some LLVMs have no instructions in double precision.
    def widened(count, low, high, z_low, z_high, phase, z):
        seen = dr.isfinite(phase)
        return [
            dr.select(seen, count + 1, count),
            dr.select(seen & (phase < low), phase, low),
            dr.select(seen & (phase > high), phase, high),
            dr.select(seen & (z < z_low), z, z_low),
            dr.select(seen & (z > z_high), z, z_high),
        ]

    real = type(planes[0][0])
    ends = [real(value) for value in (dr.inf, -dr.inf, dr.inf, -dr.inf)]
    return _Extent(*_folded(planes, widened, [UInt32(0), *ends]))


def _residual_sums(
    planes: Sequence[Plane], good: Bool, residual_of: Callable[[Real, Real], tuple[Bool, Real]]
) -> tuple[np.ndarray, np.ndarray]:
    """Residuals of each plane added up over the good pixels where they count, and how many they are; (planes,) each."""
    sums, counted = [], []
    for first in range(0, len(planes), _PLANES_AT_ONCE):
        kept = []
        for phase, z in planes[first : first + _PLANES_AT_ONCE]:
            counts, residual = residual_of(phase, z)
            kept.append((good & counts, dr.select(good & counts, residual, 0)))
        dr.eval(kept)
        sums += [dr.sum(residual) for _, residual in kept]
        counted += [dr.count(which) for which, _ in kept]
    return np.concatenate(sums), np.concatenate(counted)


def _least_squares(
    planes: Sequence[Plane], row: Callable[[Real, Real], tuple[list[Real], Real]], unknowns: int
) -> tuple[list[Real], Real]:
    """Least squares of the equations that ``row`` makes of each plane: coefficients of the unknowns, and a target."""
    real = type(planes[0][0])
    pairs = [(i, j) for i in range(unknowns) for j in range(i + 1)]

    def added(*sums_and_plane) -> list[Real]:
        *sums, phase, z = sums_and_plane
        columns, target = row(phase, z)
        factors = [(columns[i], columns[j]) for i, j in pairs] + [(column, target) for column in columns]
        return [dr.fma(a, b, total) for (a, b), total in zip(factors, sums, strict=True)]

    sums = _folded(planes, added, [real(0)] * (len(pairs) + unknowns))
    return _solved(dict(zip(pairs, sums[: len(pairs)], strict=True)), sums[len(pairs) :])


def _solved(normal: dict[tuple[int, int], Real], right: Sequence[Real]) -> tuple[list[Real], Real]:
    """Solve normal equations, given by the entries (i, j <= i), by Cholesky's factors.

    Returns
    -------
    solution : list
        Zero where the equations are singular.
    share : Float or Float64
        What each column has at least that the ones before it lack, of its square.
    """
    n, zero = len(right), 0 * right[0]
    # Columns scaled to unit length: the pivots below are then their shares.
    scale = [dr.select(normal[i, i] > 0, 1 / dr.sqrt(normal[i, i]), 0) for i in range(n)]
    lower: dict[tuple[int, int], Real] = {}
    inverse: list[Real] = []  # of the diagonal
    half_solved: list[Real] = []
    share = zero + 1
    for i in range(n):
        for j in range(i):
            rest = normal[i, j] * scale[i] * scale[j] - sum((lower[i, k] * lower[j, k] for k in range(j)), zero)
            lower[i, j] = rest * inverse[j]
        pivot = dr.select(scale[i] > 0, 1 - sum((lower[i, j] * lower[i, j] for j in range(i)), zero), 0)
        share = dr.select(pivot < share, pivot, share)
        inverse.append(1 / dr.sqrt(dr.select(pivot > _LEAST_PIVOT, pivot, 1)))
        known = sum((lower[i, k] * half_solved[k] for k in range(i)), zero)
        half_solved.append((right[i] * scale[i] - known) * inverse[i])
    solution = list(half_solved)
    for i in reversed(range(n)):
        above = sum((lower[k, i] * solution[k] for k in range(i + 1, n)), zero)
        solution[i] = (half_solved[i] - above) * inverse[i]
    return [dr.select(share > _LEAST_PIVOT, x * s, 0) for x, s in zip(solution, scale, strict=True)], share
