"""Phase-height relation of every camera pixel (section 3.1 of the paper, eq. 11-19).

Eq. 17 has seven coefficients and two exact null directions: an affine function of ``w = (m1 Φ + m0) / (n1 Φ + 1)``
is again of that form, so ``r0`` and ``r1`` say nothing that ``m1, m0, n1`` do not say. Small changes of ``m1, m0, n1``
move ``z`` along ``1, w, w²``; of the rest only ``w³`` is new, so ``r2`` is idle too. The gauge is therefore

    z = w + r3 w³,   w = (m1 t + m0) / (n1 t + 1),   r0 = r1 = r2 = 0,

with four coefficients that the data determine. ``t = (Φ - centre) / half_range`` runs from -1 to 1 over each pixel's
own calibrated phases, which keeps eq. 19 free of the bias and the bad condition that it has on raw phases of 300 rad.
"""

from collections.abc import Iterator
from dataclasses import dataclass, fields

import h5py
import numpy as np

from greenough.instrument.errors import InputError

from .phase_height_kernel import fit_pixels

PlanePhases = np.ndarray | h5py.Dataset
"""Absolute phases of planes, (planes, rows, cols) rad, NaN where invalid: an array, or one in a file, of which only
what is asked for is read."""

COEFFICIENTS = ("m1", "m0", "n1", "r3")
MIN_PLANES = 2 * len(COEFFICIENTS)
"""Planes a pixel must be valid in to be calibrated: two per coefficient."""

MISFIT_RAD = 0.25
"""A plane that misses a pixel's relation by more than this is not explained by noise or by the stage, whose 10 µm are
0.06 rad: it has a wrong fringe order, or shows something else than the board's face."""

SLOPE_TOLERANCE = 0.1
"""Largest relative departure of a pixel's dz/dΦ from that of the pixels around, a parabola over the picture. Over the
narrow field of a stereomicroscope it varies by 2 %, over a wide one by tens; a pixel that sees the board's side wall,
which passes by as the stage moves, has another one."""

STRIP_PHASES = 8_000_000
"""How many phases of all planes together are worked at."""

_SAMPLE = 2000  # pixels, whose condition and slope are looked at
_SLOPE_TOLERANCES = (0.5, 2 * SLOPE_TOLERANCE, SLOPE_TOLERANCE)  # to the slopes that the next parabola goes through
_INVERSE_STEPS = 4  # r3 w³ is a few micrometres: each squares the error


@dataclass(frozen=True)
class PhaseHeight:
    """Relation between absolute phase and height for every camera pixel.

    Parameters
    ----------
    coefficients : (rows, cols, 4) float32
        ``m1`` (mm), ``m0`` (mm), ``n1`` (dimensionless) and ``r3`` (mm⁻²) of the normalised phase.
    phase_centre, phase_half_range : (rows, cols) float32
        In rad; they normalise the phase.
    z_range : (rows, cols, 2) float32
        Lowest and highest calibrated height of the pixel in mm; a pixel at the edge of the lit field sees only part
        of the planes.
    valid : (rows, cols) bool
    """

    coefficients: np.ndarray
    phase_centre: np.ndarray
    phase_half_range: np.ndarray
    z_range: np.ndarray
    valid: np.ndarray

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, cols) of the camera."""
        rows, cols = self.valid.shape
        return rows, cols

    def height(self, phase: np.ndarray) -> np.ndarray:
        """Height z by eq. 17 for a map of absolute phases.

        Parameters
        ----------
        phase : (rows, cols)
            Absolute phase in rad, NaN where unknown.

        Returns
        -------
        (rows, cols) float64
            In mm, extrapolated where the phase leads outside ``z_range``; NaN where the pixel is not calibrated.
        """
        t = (phase - self.phase_centre.astype(np.float64)) / self.phase_half_range
        m1, m0, n1, r3 = np.moveaxis(self.coefficients.astype(np.float64), -1, 0)
        w = (m1 * t + m0) / (n1 * t + 1)
        return np.where(self.valid, w + r3 * w * w * w, np.nan)

    def slope(self, phase: np.ndarray) -> np.ndarray:
        """dz/dΦ (rows, cols) in mm/rad at absolute phases (rows, cols): the derivative of :meth:`height`."""
        t = (phase - self.phase_centre.astype(np.float64)) / self.phase_half_range
        m1, m0, n1, r3 = np.moveaxis(self.coefficients.astype(np.float64), -1, 0)
        denominator = n1 * t + 1
        w = (m1 * t + m0) / denominator
        by_t = (1 + 3 * r3 * w * w) * (m1 - n1 * m0) / denominator**2
        return np.where(self.valid, by_t / self.phase_half_range, np.nan)

    def phase(self, z: np.ndarray) -> np.ndarray:
        """Phase (rows, cols) in rad that belongs to heights z (rows, cols) in mm: the inverse of :meth:`height`."""
        m1, m0, n1, r3 = np.moveaxis(self.coefficients.astype(np.float64), -1, 0)
        w = np.asarray(z, dtype=np.float64)
        for _ in range(_INVERSE_STEPS):
            w = w - (w + r3 * w * w * w - z) / (1 + 3 * r3 * w * w)
        t = (w - m0) / (m1 - n1 * w)
        return np.where(self.valid, self.phase_centre + self.phase_half_range.astype(np.float64) * t, np.nan)

    def of_pixels(self, window: slice | tuple[slice, slice]) -> "PhaseHeight":
        """The relation of some rows, or of some rows and columns."""
        return PhaseHeight(*(getattr(self, field.name)[window] for field in fields(self)))

    def within(self, z_range: np.ndarray, valid: np.ndarray) -> "PhaseHeight":
        """The same relation, known only within other heights.

        The phase is normalised anew so that -1 to 1 are these heights; eq. 11 keeps its form.

        Parameters
        ----------
        z_range : (rows, cols, 2)
            Lowest and highest height in mm.
        valid : (rows, cols) bool
        """
        valid = valid & self.valid
        with np.errstate(all="ignore"):  # pixels that are not valid may be anything
            ends = np.stack([self.phase(z_range[..., k]) for k in range(2)])
            centre, half_range = (
                (ends.sum(axis=0) / 2).astype(np.float32),
                (np.ptp(ends, axis=0) / 2).astype(np.float32),
            )
            m1, m0, n1, r3 = np.moveaxis(self.coefficients.astype(np.float64), -1, 0)
            scale = half_range.astype(np.float64) / self.phase_half_range
            shift = (centre.astype(np.float64) - self.phase_centre) / self.phase_half_range
            unit = 1 + n1 * shift
            coefficients = np.stack([m1 * scale / unit, (m0 + m1 * shift) / unit, n1 * scale / unit, r3], axis=-1)

        return PhaseHeight(coefficients.astype(np.float32), centre, half_range, z_range, valid).where(valid)

    def where(self, valid: np.ndarray) -> "PhaseHeight":
        """The same relation, known in fewer pixels: those of ``valid``, (rows, cols) bool."""
        valid = valid & self.valid

        def kept(values: np.ndarray) -> np.ndarray:
            return np.where(valid.reshape(valid.shape + (1,) * (values.ndim - 2)), values, np.float32(np.nan))

        return PhaseHeight(
            kept(self.coefficients),
            kept(self.phase_centre),
            kept(self.phase_half_range),
            kept(self.z_range.astype(np.float32)),
            valid,
        )

    def covers(self, phase: np.ndarray, margin_mm: float) -> np.ndarray:
        """Where a phase (rows, cols) lies in the pixel's calibrated range, or outside by a height of ``margin_mm``.

        Farther out the height says nothing: eq. 11 has a pole, beyond which it comes back into the range.

        Returns
        -------
        (rows, cols) bool
        """
        low, high = np.moveaxis(self.z_range, -1, 0)
        with np.errstate(invalid="ignore"):
            t = (phase - self.phase_centre.astype(np.float64)) / self.phase_half_range
            return np.abs(t) <= 1 + 2 * margin_mm / (high - low)


@dataclass(frozen=True)
class PhaseHeightFit:
    """A fitted relation and what the fit says about itself.

    Parameters
    ----------
    relation : PhaseHeight
    residual_um : (rows, cols) float32
        RMS over the planes of fitted minus stated height; NaN where not calibrated.
    plane_residual_um : (planes,) float64
        Mean over the pixels of fitted minus stated height of each plane: what is common to all pixels is the stage's.
    condition : float
        Worst condition number of the fit's Jacobian, columns scaled to unit length, over a sample of the pixels.
    """

    relation: PhaseHeight
    residual_um: np.ndarray
    plane_residual_um: np.ndarray
    condition: float


def fit_phase_height(phases: PlanePhases, z_mm: np.ndarray, slope_tolerance: float = SLOPE_TOLERANCE) -> PhaseHeightFit:
    """Fit the phase-height relation of every pixel to planes at known heights.

    Eq. 19 on the normalised phase gives the start; Gauss-Newton steps on the height residuals of eq. 18 follow. Planes
    in which a pixel is NaN are left out for that pixel. A pixel is calibrated if it is valid in at least
    ``MIN_PLANES`` planes, no plane misses its relation by more than ``MISFIT_RAD``, and its slope is within
    ``slope_tolerance`` of the others'.

    Beside the phases and the result, memory is taken for a strip of the picture, which is so narrow that it holds
    ``STRIP_PHASES`` phases or a single row, however many planes there are.

    Parameters
    ----------
    phases : (planes, rows, cols) float32 or float64
        Absolute phase in rad, NaN where invalid. It is read strip by strip, twice.
    z_mm : (planes,)
        Height of each plane.
    slope_tolerance : float
        Infinite for phases that are a model's and of which none can be of something else.

    Raises
    ------
    InputError
        If there are fewer than ``MIN_PLANES`` distinct heights, or no pixel can be calibrated.
    """
    z_mm = np.asarray(z_mm, dtype=np.float64)
    planes, rows, cols = phases.shape
    if z_mm.shape != (planes,):
        raise ValueError(f"{planes} phase maps need {planes} heights, got an array of shape {z_mm.shape}")
    if len(np.unique(z_mm)) < MIN_PLANES:
        raise InputError(
            f"the phase-height relation needs planes at {MIN_PLANES} or more different heights, "
            f"got {len(np.unique(z_mm))}: raise procedure.planes in the rig file"
        )
    fits = [
        fit_pixels([phase.ravel() for phase in phases[:, strip]], z_mm, MIN_PLANES, MISFIT_RAD)
        for strip in strips(phases.shape)
    ]
    coefficients = np.concatenate([fit.coefficients for fit in fits], axis=1).T
    centre = np.concatenate([fit.centre for fit in fits])
    half_range = np.concatenate([fit.half_range for fit in fits])
    z_range = np.concatenate([fit.z_range for fit in fits], axis=1).T
    residual_um = 1e3 * np.concatenate([fit.rms_mm for fit in fits])
    slope = (z_range[:, 1] - z_range[:, 0]) / half_range
    with np.errstate(invalid="ignore"):
        alien = np.abs(slope / _typical_slopes(slope, (rows, cols)) - 1) > slope_tolerance
    for values in (coefficients, centre, half_range, z_range, residual_um):
        values[alien] = np.nan
    valid = np.isfinite(residual_um)
    if not valid.any():
        raise InputError(
            f"no pixel has a valid phase in {MIN_PLANES} or more of the {planes} planes: "
            "check that the board's blank side is lit by the projector and seen by the camera"
        )
    relation = PhaseHeight(
        coefficients=coefficients.reshape(rows, cols, len(COEFFICIENTS)),
        phase_centre=centre.reshape(rows, cols),
        phase_half_range=half_range.reshape(rows, cols),
        z_range=z_range.reshape(rows, cols, 2),
        valid=valid.reshape(rows, cols),
    )
    count = np.sum([fit.residual_count for fit in fits], axis=0)
    sums = np.sum([fit.residual_sum_mm for fit in fits], axis=0)
    return PhaseHeightFit(
        relation=relation,
        residual_um=residual_um.reshape(rows, cols),
        plane_residual_um=1e3 * np.divide(sums, count, out=np.full(planes, np.nan), where=count > 0),
        condition=_worst_condition(phases, relation),
    )


def _typical_slopes(slope: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """The parabola over the picture that most of the slopes (pixels,) lie on, (pixels,); NaN where none is known."""
    at = np.flatnonzero(np.isfinite(slope))
    at = at[:: max(1, len(at) // _SAMPLE)]
    if len(at) == 0:
        return slope
    median = np.median(slope[at])
    typical = np.full(len(at), median)
    for tolerance in _SLOPE_TOLERANCES:
        alike = at[np.abs(slope[at] / typical - 1) < tolerance]
        solution = np.linalg.lstsq(_parabola(alike, shape), slope[alike] / median, rcond=None)[0]
        typical = median * (_parabola(at, shape) @ solution)
    return median * (_parabola(np.arange(len(slope)), shape) @ solution)


def _parabola(pixels: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """(n, 6) of pixels' numbers (n,)."""
    y, x = (at / size - 0.5 for at, size in zip(np.divmod(pixels, shape[1]), shape, strict=True))
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)


def strips(shape: tuple[int, int, int]) -> Iterator[slice]:
    """Rows (planes, rows, cols) divided into strips that hold ``STRIP_PHASES`` phases or a single row."""
    planes, rows, cols = shape
    height = max(1, STRIP_PHASES // (planes * cols))
    return (slice(top, min(top + height, rows)) for top in range(0, rows, height))


def _worst_condition(phases: PlanePhases, relation: PhaseHeight) -> float:
    """Largest condition number of the scaled Jacobian over a sample of the pixels."""
    row, col = np.nonzero(relation.valid)
    row, col = (at[:: max(1, len(at) // _SAMPLE)] for at in (row, col))
    parts = []
    for strip in strips(phases.shape):
        inside = (row >= strip.start) & (row < strip.stop)
        parts.append(phases[:, strip][:, row[inside] - strip.start, col[inside]])
    phi = np.concatenate(parts, axis=1).astype(np.float64)  # (planes, n)
    seen = np.isfinite(phi)
    t = np.where(seen, (phi - relation.phase_centre[row, col]) / relation.phase_half_range[row, col], 0.0)
    m1, m0, n1, r3 = relation.coefficients[row, col].T.astype(np.float64)
    denominator = 1 / (n1 * t + 1)
    w = (m1 * t + m0) * denominator
    slope = (1 + 3 * r3 * w**2) * denominator
    jacobian = np.stack([slope * t, slope, -slope * t * w, w**3], axis=-1) * seen[..., None]  # (planes, n, 4)
    jacobian = np.moveaxis(jacobian, 1, 0)
    return float(np.linalg.cond(jacobian / np.linalg.norm(jacobian, axis=1, keepdims=True)).max())
