"""The fit of eq. 17 to planes at known heights, for many pixels at once: one kernel, in which each pixel is a lane.

The planes are gone through five times, and what is needed of them is summed up on the way: their extent, the normal
equations of eq. 19, those of two Gauss-Newton steps, and the residuals. Sums and their solution are in double
precision: where a pixel saw a few planes at one end alone, w³ is all but a sum of the other columns, and what is left
of it, squared, would drown in single precision.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from .jit import Bool, Float, Float64, UInt32, dr

_REFINEMENTS = 2
_LEAST_PIVOT = 1e-10  # share of a column's square that the columns before it lack


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


def fit_pixels(phases: np.ndarray, z_mm: np.ndarray, min_planes: int, misfit_rad: float) -> PixelFits:
    """Fit every pixel by itself.

    Parameters
    ----------
    phases : (planes, n) float32 or float64
        Absolute phase in rad, NaN where invalid.
    z_mm : (planes,)
    min_planes : int
        In which a pixel must be valid to be fitted.
    misfit_rad : float
        By less than which every plane must keep to a pixel's relation; a pixel that fails is not fitted.
    """
    planes = _Planes.of(phases, z_mm)
    extent = planes.extent()
    usable = (extent.count >= min_planes) & (extent.high > extent.low)
    # The stored numbers are float32: normalise with exactly what will be stored.
    centre = Float(dr.select(usable, (extent.low + extent.high) / 2, 0))
    half_range = Float(dr.select(usable, (extent.high - extent.low) / 2, 1))

    def point(k: UInt32) -> tuple[Bool, Float64, Float64]:
        """Whether plane k counts, its normalised phase (0 if not), its height."""
        phase, z = planes.at(k)
        counts = dr.isfinite(phase) & usable
        return counts, dr.select(counts, (phase - Float64(centre)) / Float64(half_range), 0), z

    def eq_19(k: UInt32) -> tuple[list[Float64], Float64]:
        """m1 t - n1 t z + m0 = z."""
        counts, t, z = point(k)
        one = dr.select(counts, Float64(1), 0)
        return [t, one, -t * z], one * z

    m1, m0, n1 = planes.least_squares(eq_19, 3)
    r3 = dr.zeros(Float64, planes.pixels)
    for _ in range(_REFINEMENTS):

        def eq_18(k: UInt32, m1=m1, m0=m0, n1=n1, r3=r3) -> tuple[list[Float64], Float64]:
            counts, t, z = point(k)
            inverse = 1 / (n1 * t + 1)
            w = (m1 * t + m0) * inverse
            cube = w * w * w
            slope = dr.select(counts, (1 + 3 * r3 * w * w) * inverse, 0)  # dz/dw times dw/d(numerator)
            return [slope * t, slope, -slope * t * w, dr.select(counts, cube, 0)], z - w - r3 * cube

        step = planes.least_squares(eq_18, 4)
        m1, m0, n1, r3 = m1 + step[0], m0 + step[1], n1 + step[2], r3 + step[3]

    residuals = dr.full(Float, dr.nan, len(phases) * planes.pixels)

    def judge(k: UInt32, worst: Float64, squares: Float64) -> tuple[Float64, Float64]:
        counts, t, z = point(k)
        w = (m1 * t + m0) / (n1 * t + 1)
        residual = dr.select(counts, w + r3 * w * w * w - z, 0)
        dr.scatter(residuals, Float(residual), planes.place(k), counts)
        size = dr.select(dr.isfinite(residual), dr.abs(residual), dr.inf)
        return dr.maximum(worst, size), squares + residual * residual

    worst, squares = planes.over(judge, [dr.zeros(Float64, planes.pixels) for _ in range(2)])
    good = usable & (worst < misfit_rad * (extent.z_high - extent.z_low) / (2 * Float64(half_range)))
    rms = dr.sqrt(squares / dr.maximum(Float64(extent.count), 1))
    results = [
        Float(dr.select(good, value, dr.nan))
        for value in (m1, m0, n1, r3, centre, half_range, extent.z_low, extent.z_high, rms)
    ]
    dr.eval(*results, good, residuals)
    counted = dr.tile(good, len(phases)) & dr.isfinite(residuals)
    sums = dr.block_sum(dr.select(counted, Float64(residuals), 0), planes.pixels)
    counts = dr.block_sum(dr.select(counted, UInt32(1), 0), planes.pixels)
    values = np.array([np.array(result) for result in results])
    return PixelFits(values[:4], values[4], values[5], values[6:8], values[8], np.array(sums), np.array(counts))


@dataclass(frozen=True, eq=False)
class _Extent:
    """Of each pixel over the planes in which it has a phase."""

    count: UInt32
    low: Float64  # phase, rad
    high: Float64
    z_low: Float64
    z_high: Float64


@dataclass(frozen=True, eq=False)
class _Planes:
    """Phases and heights on the device, and loops over them."""

    phases: Float | Float64
    heights: Float64
    count: UInt32  # opaque like ``stride``, so that one kernel is compiled for any number of planes and pixels
    stride: UInt32
    pixels: int

    @classmethod
    def of(cls, phases: np.ndarray, z_mm: np.ndarray) -> "_Planes":
        count, pixels = phases.shape
        kind = Float64 if phases.dtype == np.float64 else Float
        sizes = dr.opaque(UInt32, count), dr.opaque(UInt32, pixels)
        return cls(kind(np.ascontiguousarray(phases).ravel()), Float64(z_mm), *sizes, pixels)

    def place(self, k: UInt32) -> UInt32:
        """Of each pixel's phase in plane k."""
        return k * self.stride + dr.arange(UInt32, self.pixels)

    def at(self, k: UInt32) -> tuple[Float64, Float64]:
        """Phase of each pixel in plane k, and its height."""
        return Float64(dr.gather(type(self.phases), self.phases, self.place(k))), dr.gather(Float64, self.heights, k)

    def over(self, body: Callable[..., Sequence[dr.ArrayBase]], state: Sequence[dr.ArrayBase]) -> tuple:
        """The state after ``state = body(k, *state)`` for every plane k."""
        return dr.while_loop(
            (UInt32(0), *state),
            lambda k, *state: k < self.count,
            lambda k, *state: (k + 1, *body(k, *state)),
        )[1:]

    def extent(self) -> _Extent:
        def widened(k, count, low, high, z_low, z_high):
            phase, z = self.at(k)
            seen = dr.isfinite(phase)
            return (
                dr.select(seen, count + 1, count),
                dr.select(seen, dr.minimum(low, phase), low),
                dr.select(seen, dr.maximum(high, phase), high),
                dr.select(seen, dr.minimum(z_low, z), z_low),
                dr.select(seen, dr.maximum(z_high, z), z_high),
            )

        ends = [dr.full(Float64, value, self.pixels) for value in (dr.inf, -dr.inf, dr.inf, -dr.inf)]
        return _Extent(*self.over(widened, [dr.zeros(UInt32, self.pixels), *ends]))

    def least_squares(self, row: Callable[[UInt32], tuple[list[Float64], Float64]], unknowns: int) -> list[Float64]:
        """Least squares by the normal equations of the rows, coefficients and target, that the planes have."""
        pairs = [(i, j) for i in range(unknowns) for j in range(i + 1)]

        def added(k: UInt32, *sums: Float64) -> list[Float64]:
            columns, target = row(k)
            terms = [columns[i] * columns[j] for i, j in pairs] + [column * target for column in columns]
            return [total + term for total, term in zip(sums, terms, strict=True)]

        zero = [dr.zeros(Float64, self.pixels) for _ in range(len(pairs) + unknowns)]
        sums = self.over(added, zero)
        return _solve(dict(zip(pairs, sums[: len(pairs)], strict=True)), sums[len(pairs) :])


def _solve(normal: dict[tuple[int, int], Float64], right: Sequence[Float64]) -> list[Float64]:
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
