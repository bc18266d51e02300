"""A global model as maps of every pixel: its ray, its phase-height relation, and what its planes leave over.

The model is smooth, so it is evaluated on a coarse grid of pixels and continued by cubic splines in between.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import RectBivariateSpline

from .bundle_data import block_map, block_side
from .instrument_model import InstrumentModel
from .jit import dr
from .phase_height import MISFIT_RAD, PhaseHeight, PlanePhases, fit_phase_height
from .rays import Rays

_GRID_PX = 8
_HEIGHTS = 16  # at which the relation is fitted to the model: four times its coefficients

Surface = Callable[[int, np.ndarray], np.ndarray]
"""Height (n,) of plane k at (n, 2) x, y."""


def model_maps(instrument: InstrumentModel, z_low: float, z_high: float) -> tuple[Rays, PhaseHeight]:
    """Rays and phase-height relation of every pixel of the camera, from ``z_low`` to ``z_high`` mm.

    The relation is fitted to the model's phases at 16 heights along the ray as it would be to measured planes. Every
    pixel counts as valid over the whole range: what was really seen is for `plane_residuals` to say.
    """
    rows, cols = instrument.camera.camera.shape
    grid_v, grid_u = (np.linspace(0, n - 1, max(4, -(-n // _GRID_PX))) for n in (rows, cols))
    v, u = np.meshgrid(grid_v, grid_u, indexing="ij")
    pixels = np.stack([u.ravel(), v.ravel()], axis=-1)
    low, high = (instrument.points(pixels, np.full(len(pixels), z))[:, :2] for z in (z_low, z_high))
    slope = (high - low) / (z_high - z_low)
    origin = low - z_low * slope
    heights = (z_low + z_high) / 2 - (z_high - z_low) / 2 * np.cos(np.linspace(0, np.pi, _HEIGHTS))
    on_rays = (np.column_stack([origin + z * slope, np.full(len(pixels), z)]) for z in heights)
    phases = np.stack([instrument.projector.phase(xyz).reshape(v.shape) for xyz in on_rays])
    relation = fit_phase_height(phases, heights, slope_tolerance=np.inf).relation

    def everywhere(coarse: np.ndarray) -> np.ndarray:
        """(grid rows, grid cols, n) to (rows, cols, n)."""
        planes = np.moveaxis(coarse.astype(float), -1, 0)
        smooth = [RectBivariateSpline(grid_v, grid_u, plane)(np.arange(rows), np.arange(cols)) for plane in planes]
        return np.stack(smooth, axis=-1).astype(np.float32)

    return (
        Rays(everywhere(origin.reshape(*v.shape, 2)), everywhere(slope.reshape(*v.shape, 2))),
        PhaseHeight(
            coefficients=everywhere(relation.coefficients),
            phase_centre=everywhere(relation.phase_centre[..., None])[..., 0],
            phase_half_range=everywhere(relation.phase_half_range[..., None])[..., 0],
            z_range=np.tile(np.array([z_low, z_high], dtype=np.float32), (rows, cols, 1)),
            valid=np.ones((rows, cols), dtype=bool),
        ),
    )


@dataclass(frozen=True, eq=False)
class PlaneResiduals:
    """How planes lie against a relation.

    A plane counts for a pixel if its phase is valid and misses the relation by less than ``MISFIT_RAD``.

    Parameters
    ----------
    blocks_um : (planes, grid rows, grid cols) float32
        Measured height minus the plane's, means over the blocks of `bundle_data.block_averages`, NaN where too few
        pixels count.
    pixels_um : (rows, cols) float32
        The same, root mean square over the planes; NaN where none counts.
    count : (rows, cols) int
        How many count.
    """

    blocks_um: np.ndarray
    pixels_um: np.ndarray
    count: np.ndarray


def plane_residuals(relation: PhaseHeight, rays: Rays, phases: PlanePhases, surface: Surface) -> PlaneResiduals:
    """Compare planes, whose absolute phases are (planes, rows, cols) with NaN where invalid, with a relation."""
    rows, cols = relation.shape
    side = block_side(cols)
    grid_rows, grid_cols = rows // side, cols // side
    blocks = np.full((len(phases), grid_rows, grid_cols), np.nan, dtype=np.float32)
    pixels = np.empty((rows, cols), dtype=np.float32)
    count = np.empty((rows, cols), dtype=int)

    def compare(top: int) -> None:
        """One row of blocks, plane by plane."""
        strip = slice(top, min(top + side, rows))
        part = relation.of_pixels(strip)
        origin, slope = rays.origin[strip], rays.slope[strip]
        span = part.z_range[..., 1] - part.z_range[..., 0]
        limit = MISFIT_RAD * span / (2 * part.phase_half_range)
        squares = np.zeros(part.shape)
        for k in range(len(phases)):
            height = part.height(phases[k, strip])
            plane = surface(k, (origin + height[..., None] * slope).reshape(-1, 2)).reshape(part.shape)
            counts = np.abs(height - plane) < limit
            residual = np.where(counts, height - plane, np.nan)
            if top // side < grid_rows:
                blocks[k, top // side] = 1e3 * block_map(residual)[0]
            squares += np.where(counts, residual, 0.0) ** 2
            count[strip] = counts + (count[strip] if k else 0)
        seen = count[strip] > 0
        pixels[strip] = np.where(seen, 1e3 * np.sqrt(squares / np.maximum(count[strip], 1)), np.nan)

    with ThreadPoolExecutor(dr.thread_count()) as pool:
        list(pool.map(compare, range(0, rows, side)))
    return PlaneResiduals(blocks, pixels, count)
