"""The fit of eq. 17 to planes at known heights, for many pixels at once: each pixel is a lane of the same kernels.

The planes are gone through five times, and what is needed of them is added up on the way: their extent, the normal
equations of eq. 19, those of two Gauss-Newton steps, and the residuals. All in double precision: where a pixel saw a
few planes at one end alone, w³ is all but a sum of the other columns. What it has of its own is then so little that the
rounding of single precision, even of the columns alone, moves heights by more than a tenth of their noise.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from greenough.instrument.packets import packed

from .jit import Bool, Float, Float64, UInt32, dr

_REFINEMENTS = 2
_LEAST_PIVOT = 1e-10  # share of a column's square that the columns before it lack
_PLANES_AT_ONCE = 32  # of which a kernel is made: it takes longer to compile with every one


Phase = Float | Float64
"""Of every pixel in one plane."""

Plane = tuple[Phase, Float64]
"""With its height."""


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
        Absolute phase in each plane, rad, NaN where invalid.
    z_mm : (planes,)
    min_planes : int
        In which a pixel must be valid to be fitted.
    misfit_rad : float
        By less than which every plane must keep to a pixel's relation; a pixel that fails is not fitted.
    """
    kind = Float64 if phases[0].dtype == np.float64 else Float
    planes = [(kind(packed(phase)), dr.opaque(Float64, z)) for phase, z in zip(phases, z_mm, strict=True)]
    extent = _extent_of(planes)
    usable = (extent.count >= min_planes) & (extent.high > extent.low)
    # The stored numbers are float32: normalise with exactly what will be stored.
    centre = Float(dr.select(usable, (extent.low + extent.high) / 2, 0))
    half_range = Float(dr.select(usable, (extent.high - extent.low) / 2, 1))
    middle, per_rad = Float64(centre), 1 / Float64(half_range)
    dr.eval(usable, middle, per_rad)

    def normalised(phase: Phase) -> tuple[Bool, Float64]:
        """Which phases count, and what they are between the ends of their range; 0 if they do not count."""
        counts = dr.isfinite(phase) & usable
        return counts, dr.select(counts, (Float64(phase) - middle) * per_rad, 0)

    def eq_19(phase: Phase, z: Float64) -> tuple[list[Float64], Float64]:
        """m1 t - n1 t z + m0 = z."""
        counts, t = normalised(phase)
        one = dr.select(counts, Float64(1), 0)
        return [t, one, -t * z], one * z

    def eq_18(
        m1: Float64, m0: Float64, n1: Float64, r3: Float64, phase: Phase, z: Float64
    ) -> tuple[list[Float64], Float64]:
        """Height by steps of the four coefficients: what is missing to the stated one."""
        counts, t = normalised(phase)
        inverse = 1 / (n1 * t + 1)
        w = (m1 * t + m0) * inverse
        cube = w * w * w
        slope = dr.select(counts, (1 + 3 * r3 * w * w) * inverse, 0)  # dz/dw times dw/d(numerator)
        return [slope * t, slope, -slope * t * w, dr.select(counts, cube, 0)], z - w - r3 * cube

    coefficients = [*_least_squares(planes, eq_19, 3), dr.zeros(Float64, len(phases[0]))]
    dr.eval(*coefficients)
    for _ in range(_REFINEMENTS):
        steps = _least_squares(planes, partial(eq_18, *coefficients), 4)
        coefficients = [value + step for value, step in zip(coefficients, steps, strict=True)]
        dr.eval(*coefficients)

    def residual_of(phase: Phase, z: Float64) -> tuple[Bool, Float64]:
        """Which residuals, fitted minus stated height, count; and all of them."""
        counts, t = normalised(phase)
        m1, m0, n1, r3 = coefficients
        w = (m1 * t + m0) / (n1 * t + 1)
        return counts, w + r3 * w * w * w - z

    limit = misfit_rad * (extent.z_high - extent.z_low) / 2 * per_rad

    def judged(astray: Bool, squares: Float64, phase: Phase, z: Float64) -> list[Bool | Float64]:
        counts, residual = residual_of(phase, z)
        near = dr.abs(residual) < limit  # not where it is NaN
        return [astray | (counts & ~near), squares + dr.select(counts, residual * residual, 0)]

    astray, squares = _folded(planes, judged, [Bool(False), Float64(0)])
    good = usable & ~astray
    rms = dr.sqrt(squares / Float64(extent.count))
    values = [*coefficients, centre, half_range, extent.z_low, extent.z_high, rms]
    results = [Float(dr.select(good, value, dr.nan)) for value in values]
    dr.eval(good, *results)
    sums, counted = [], []
    for first in range(0, len(planes), _PLANES_AT_ONCE):
        kept = []
        for phase, z in planes[first : first + _PLANES_AT_ONCE]:
            counts, residual = residual_of(phase, z)
            kept.append((good & counts, dr.select(good & counts, residual, 0)))
        dr.eval(kept)
        sums += [dr.sum(residual) for _, residual in kept]
        counted += [dr.count(which) for which, _ in kept]
    table = np.array([np.array(result) for result in results])
    return PixelFits(
        coefficients=table[:4],
        centre=table[4],
        half_range=table[5],
        z_range=table[6:8],
        rms_mm=table[8],
        residual_sum_mm=np.concatenate(sums),
        residual_count=np.concatenate(counted),
    )


@dataclass(frozen=True, eq=False)
class _Extent:
    """Of each pixel over the planes in which it has a phase."""

    count: UInt32
    low: Phase
    high: Phase
    z_low: Float64
    z_high: Float64


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

    kind = type(planes[0][0])
    start = [UInt32(0), kind(dr.inf), kind(-dr.inf), Float64(dr.inf), Float64(-dr.inf)]
    return _Extent(*_folded(planes, widened, start))


def _least_squares(
    planes: Sequence[Plane], row: Callable[[Phase, Float64], tuple[list[Float64], Float64]], unknowns: int
) -> list[Float64]:
    """Least squares of the equations that ``row`` makes of each plane: coefficients of the unknowns, and a target."""
    pairs = [(i, j) for i in range(unknowns) for j in range(i + 1)]

    def added(*sums_and_plane) -> list[Float64]:
        *sums, phase, z = sums_and_plane
        columns, target = row(phase, z)
        factors = [(columns[i], columns[j]) for i, j in pairs] + [(column, target) for column in columns]
        return [dr.fma(a, b, total) for (a, b), total in zip(factors, sums, strict=True)]

    sums = _folded(planes, added, [Float64(0)] * (len(pairs) + unknowns))
    return _solved(dict(zip(pairs, sums[: len(pairs)], strict=True)), sums[len(pairs) :])


def _solved(normal: dict[tuple[int, int], Float64], right: Sequence[Float64]) -> list[Float64]:
    """Solve normal equations, given by the entries (i, j <= i), by Cholesky's factors; zero where singular."""
    n = len(right)
    # Columns scaled to unit length: the pivots below are then the share of each column that the earlier ones lack.
    scale = [dr.select(normal[i, i] > 0, 1 / dr.sqrt(normal[i, i]), 0) for i in range(n)]
    lower: dict[tuple[int, int], Float64] = {}
    inverse: list[Float64] = []  # of the diagonal
    half_solved: list[Float64] = []
    regular = Bool(True)
    for i in range(n):
        for j in range(i):
            rest = normal[i, j] * scale[i] * scale[j] - sum(lower[i, k] * lower[j, k] for k in range(j))
            lower[i, j] = rest * inverse[j]
        pivot = dr.select(scale[i] > 0, 1 - sum((lower[i, j] * lower[i, j] for j in range(i)), Float64(0)), 0)
        regular &= pivot > _LEAST_PIVOT
        inverse.append(1 / dr.sqrt(dr.select(pivot > _LEAST_PIVOT, pivot, 1)))
        half_solved.append((right[i] * scale[i] - sum(lower[i, k] * half_solved[k] for k in range(i))) * inverse[i])
    solution: list[Float64] = list(half_solved)
    for i in reversed(range(n)):
        above = sum(lower[k, i] * solution[k] for k in range(i + 1, n))
        solution[i] = (half_solved[i] - above) * inverse[i]
    return [dr.select(regular, x * s, 0) for x, s in zip(solution, scale, strict=True)]
