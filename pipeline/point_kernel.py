"""Eq. 17, the calibrated range and eq. 23 of every pixel as one kernel, with what the phase's noise does to its point.

In single precision: the difference of a phase of 300 rad and its pixel's centre is exact, and all that follows is of
the size of 1 or of the field in mm, so that what rounding adds is about a nanometre.
"""

from dataclasses import dataclass

import numpy as np

from greenough.instrument.packets import packed

from .jit import Array4f, Array4f64, Bool, Float, Float64, UInt32, dr
from .phase_height import PhaseHeight
from .rays import Rays


@dataclass(frozen=True, eq=False)
class PointKernel:
    """A calibration as the kernel reads it: eleven arrays (pixels,), together 44 bytes for each pixel.

    Parameters
    ----------
    m1, m0, n1, r3 : Float
        Coefficients of eq. 17 in the gauge of `phase_height`.
    centre, per_half_range : Float
        t = (Φ - centre) per_half_range is the normalised phase.
    reach : Float
        Largest |t| at which the relation is believed; NaN where a pixel has no relation or no ray.
    x, y, dx, dy : Float
        The ray: its x and y at z = 0, mm, and how they change with z.
    """

    m1: Float
    m0: Float
    n1: Float
    r3: Float
    centre: Float
    per_half_range: Float
    reach: Float
    x: Float
    y: Float
    dx: Float
    dy: Float

    @classmethod
    def of(cls, relation: PhaseHeight, rays: Rays, margin_mm: float) -> "PointKernel":
        """That of a relation which is believed by ``margin_mm`` beyond each pixel's calibrated heights."""
        known = relation.valid & np.isfinite(rays.origin).all(axis=-1) & np.isfinite(rays.slope).all(axis=-1)
        low, high = np.moveaxis(relation.z_range, -1, 0)
        with np.errstate(all="ignore"):  # pixels that are not known may be anything
            reach = np.where(known, 1 + 2 * margin_mm / (high - low), np.nan)
            per_half_range = 1 / relation.phase_half_range
        maps = (
            *np.moveaxis(relation.coefficients, -1, 0),
            relation.phase_centre,
            per_half_range,
            reach,
            *np.moveaxis(rays.origin, -1, 0),
            *np.moveaxis(rays.slope, -1, 0),
        )
        return cls(*(Float(packed(values.astype(np.float32), aligned=True)) for values in maps))

    def points(self, phase: np.ndarray, sigma: np.ndarray, valid: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Points of a phase map and what one standard deviation of its noise moves them by.

        Parameters
        ----------
        phase, sigma : (rows, cols)
            Absolute phase and its standard deviation, rad.
        valid : (rows, cols) bool
            Where the phase is known.

        Returns
        -------
        (rows, cols, 3) float64, (rows, cols, 3) float32
            mm, NaN where there is no point. Both are views of arrays of four numbers a pixel: a packet of four is
            written at once, one of three is not.
        """
        known = Bool(packed(valid))
        t = (Float(packed(phase.astype(np.float32, copy=False))) - self.centre) * self.per_half_range
        inverse = dr.rcp(self.n1 * t + 1)
        w = (self.m1 * t + self.m0) * inverse
        bend = self.r3 * w * w
        known &= dr.abs(t) <= self.reach  # not where either is NaN
        z = dr.select(known, w + bend * w, dr.nan)
        by_phase = (1 + 3 * bend) * (self.m1 - self.n1 * w) * inverse * self.per_half_range
        noise = dr.select(known, by_phase * Float(packed(sigma.astype(np.float32, copy=False))), dr.nan)

        place = dr.arange(UInt32, phase.size)
        xyz, noise_mm = dr.empty(Float64, 4 * phase.size), dr.empty(Float, 4 * phase.size)
        point = Array4f64(Float64(self.x + z * self.dx), Float64(self.y + z * self.dy), Float64(z), 0)
        dr.scatter(xyz, point, place)
        dr.scatter(noise_mm, Array4f(noise * self.dx, noise * self.dy, noise, 0), place)
        dr.eval(xyz, noise_mm)
        by_pixel, noise_by_pixel = (values.numpy().reshape(*phase.shape, 4) for values in (xyz, noise_mm))
        return by_pixel[..., :3], noise_by_pixel[..., :3]
