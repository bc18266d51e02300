"""Rays that meet given points of the stop, whose image the lenses between distort.

A pupil's nodes must fill the stop itself, wherever a ray comes from: nodes that miss the stop's edge here and there
blink from pixel to pixel. Newton's iteration finds each ray exactly; inside the renderer a cubic polynomial, fitted to
such rays once for each path as it was built, comes within a micrometre.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations_with_replacement
from typing import Any

import numpy as np
from scipy.stats import qmc

from greenough.instrument.packets import packed

from ..renderer import dr
from .paraxial import DESIGN_WAVELENGTH_UM, Pupil, paraxial
from .placed import PlacedPath
from .trace import Double, Rays, follow, image_point, rays_through, way

DEGREE = 3
VARIABLES = 4  # field x, y and stop x, y
MONOMIALS = [c for degree in range(DEGREE + 1) for c in combinations_with_replacement(range(VARIABLES), degree)]

# Where the polynomials are fitted: a little more than the image, and more than the stage's travel.
MARGIN = 1.08
DEPTH = 2.0
SAMPLES = 1024
ITERATIONS = 9  # each leaves at most a hundredth of the error


def aim_exactly(
    path: PlacedPath, point: tuple[Any, Any, Any], stop_x: Any, stop_y: Any, wavelength_um: Any, outwards: bool
) -> Rays:
    """Rays from ``point``, path coordinates, through (stop_x, stop_y) in mm on the stop; Newton's iteration.

    Points lie on the specimen's side if ``outwards``, else at the image.
    """
    stop = path.prescription.stop
    between = range(stop + 1) if outwards else range(stop, len(path.surfaces))
    pupil = _pupil(path, outwards)
    x, y = stop_x * pupil.magnification, stop_y * pupil.magnification
    crossings = way(path, type(x), outwards, between)
    for _ in range(ITERATIONS):
        met, _ = follow(crossings, rays_through(*point, x, y, pupil.z, outwards), wavelength_um, outwards)
        x -= (met.x - stop_x) * pupil.magnification
        y -= (met.y - stop_y) * pupil.magnification
        dr.eval(x, y)
    return rays_through(*point, x, y, pupil.z, outwards)


@dataclass(frozen=True, eq=False)
class Aim:
    """Polynomials of (field, stop) that say where in the paraxial pupil's plane to aim, and the light to expect."""

    outwards: bool
    pupil: Pupil
    stop_radius: float
    half_field: tuple[float, float]
    coefficients: Sequence[Sequence[Any]]  # (monomials, 3): pupil x, y in mm beyond the paraxial ones, relative weight

    def __call__(self, point: tuple[Any, Any, Any], disk_x: Any, disk_y: Any) -> tuple[Any, Any, Any]:
        """Aim from ``point`` through a point of the unit disk, which is the stop.

        Returns where in the pupil's plane to head for, (x, y), and the weight of that part of the stop against its
        middle seen from the middle of the field: from the image its projected solid angle, outwards the area of its
        image in the pupil's plane.
        """
        x, y, monomials = self.terms(point, disk_x, disk_y)
        sums = [x, y, 0.0]
        for monomial, row in zip(monomials, self.coefficients, strict=True):
            sums = [dr.fma(value, monomial, total) for value, total in zip(row, sums, strict=True)]
        return sums[0], sums[1], sums[2]

    def terms(self, point: tuple[Any, Any, Any], disk_x: Any, disk_y: Any) -> tuple[Any, Any, list[Any]]:
        """Where to aim by first-order optics, (x, y), and the monomials that the rest is made of."""
        scale = self.stop_radius * self.pupil.magnification
        x, y = disk_x * scale, disk_y * scale
        field_x, field_y = point[0], point[1]
        if self.outwards:  # the field is where the ray crosses z = 0
            t = point[2] / (point[2] - self.pupil.z)
            field_x, field_y = dr.fma(t, x - field_x, field_x), dr.fma(t, y - field_y, field_y)
        return x, y, _monomials(field_x / self.half_field[0], field_y / self.half_field[1], disk_x, disk_y)


def fit_aim(path: PlacedPath, outwards: bool) -> Aim:
    """The polynomials for rays from the specimen (``outwards``) or from the image, at the design wavelength."""
    image = path.prescription.image
    scale = abs(paraxial(path.prescription).magnification) if outwards else 1.0
    half_field = MARGIN * image.width / 2 / scale, MARGIN * image.height / 2 / scale
    unfitted = Aim(
        outwards, _pupil(path, outwards), path.prescription.stop_radius, half_field, [(0.0, 0.0, 0.0)] * len(MONOMIALS)
    )
    u = 2 * qmc.Sobol(VARIABLES + 1, rng=np.random.default_rng(1)).random(SAMPLES).T - 1
    x, y, depth = (_double(most * u[k]) for k, most in ((0, half_field[0]), (1, half_field[1]), (4, DEPTH)))
    radius, angle = np.sqrt((u[2] + 1) / 2), np.pi * u[3]
    disk = np.stack([radius * np.cos(angle), radius * np.sin(angle)])
    point = (x, y, depth) if outwards else image_point(path.image, x, y)
    middle = (Double(0), Double(0), Double(0)) if outwards else image_point(path.image, Double(0), Double(0))

    ideal_x, ideal_y, monomials = unfitted.terms(point, _double(disk[0]), _double(disk[1]))
    heads = _pupil_points(path, point, disk, outwards)
    weight = _weights(path, point, disk, outwards) / _weights(path, middle, np.zeros((2, 1)), outwards)
    values = np.stack([np.broadcast_to(np.array(monomial), SAMPLES) for monomial in monomials], axis=1)
    target = np.stack([heads[0] - np.array(ideal_x), heads[1] - np.array(ideal_y), weight], axis=1)
    return replace(unfitted, coefficients=np.linalg.lstsq(values, target, rcond=None)[0].tolist())


def _pupil(path: PlacedPath, outwards: bool) -> Pupil:
    summary = paraxial(path.prescription)
    return summary.entrance if outwards else summary.exit


def _pupil_points(path: PlacedPath, point: tuple[Any, Any, Any], disk: np.ndarray, outwards: bool) -> np.ndarray:
    """Where exact rays cross the paraxial pupil's plane, (2, n)."""
    rays = _exact(path, point, disk, outwards)
    t = (_pupil(path, outwards).z - rays.z) / rays.n
    return np.array([np.array(rays.x + t * rays.l), np.array(rays.y + t * rays.m)])


def _exact(path: PlacedPath, point: tuple[Any, Any, Any], disk: np.ndarray, outwards: bool) -> Rays:
    stop_x, stop_y = (_double(axis * path.prescription.stop_radius) for axis in disk)
    return aim_exactly(path, point, stop_x, stop_y, DESIGN_WAVELENGTH_UM, outwards)


def _double(values: np.ndarray) -> Any:
    return Double(packed(values, aligned=True))


def _weights(path: PlacedPath, point: tuple[Any, Any, Any], disk: np.ndarray, outwards: bool) -> np.ndarray:
    """What ``Aim`` returns as weight, not normalised, (n,), by central differences over the stop."""
    step = 1e-3
    sides = [disk + np.array(offset)[:, None] for offset in ((step, 0), (-step, 0), (0, step), (0, -step))]
    if outwards:
        heads = [_pupil_points(path, point, side, outwards) for side in sides]
        along_x, along_y = heads[0] - heads[1], heads[2] - heads[3]
        return np.abs(along_x[0] * along_y[1] - along_x[1] * along_y[0])
    directions = [np.array([np.array(c) for c in _exact(path, point, side, outwards)[3:]]) for side in sides]
    solid_angle = np.cross(directions[0] - directions[1], directions[2] - directions[3], axis=0)
    # As a vector it points along the ray: along the image's normal it is the projected one.
    return np.abs(np.array(path.image.normal) @ solid_angle)


def _monomials(*variables: Any) -> list[Any]:
    """Values of MONOMIALS, each from one of lower degree."""
    values: dict[tuple[int, ...], Any] = {(): 1.0}
    for powers in MONOMIALS[1:]:
        values[powers] = variables[powers[-1]] * values[powers[:-1]]
    return list(values.values())
