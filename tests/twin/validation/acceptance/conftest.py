"""Artefacts as they would be measured from straight above, without a renderer: truth and points are set by the test."""

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from greenough.pipeline.calibration_uncertainty import GRID, CalibrationUncertainty
from greenough.pipeline.point_spread import PointSpread
from greenough.pipeline.reconstruct import PointMap
from greenough.scenes.parts import Specimen
from greenough.twin.validation.acceptance.artefacts import Artefact, Treated
from greenough.twin.validation.acceptance.rows import Row
from greenough.twin.validation.setup import Setup

SHIFT = np.eye(4)
SHIFT[:3, 3] = [0.05, -0.03, 0.1]
SIGMA_MM = 1e-3


def uncertainty(scale: float, pixel: float) -> CalibrationUncertainty:
    """One cause: all lengths may be too long by a share of standard deviation ``scale``; ``pixel`` is in mm."""
    heights, v, u = (np.linspace(*ends, n) for ends, n in zip(((-2.0, 2.0), (0, 999), (0, 999)), GRID, strict=True))
    z, row, col = np.meshgrid(heights, v, u, indexing="ij")
    points = np.stack([pixel * col, -pixel * row, z], axis=-1)
    return CalibrationUncertainty(heights, v, u, (scale * points[None]).astype(np.float32), np.zeros(GRID[0]))


@pytest.fixture
def setup(analytic) -> Setup:
    """Pixels of 9.9 um; the calibration believes the board."""
    made = analytic(SHIFT, method="bundle")
    made.calibration.point_spread = PointSpread(0.565, 0.0, (0.0, 0.0, 0.0, 0.0), (960, 1280))
    return made


@pytest.fixture
def measured() -> Callable[..., Artefact]:
    """Makes an artefact, which lies shifted by ``SHIFT``, of true points (rows, cols, 3) in its own frame.

    ``errors`` (rows, cols) or one number are added to the heights, and noise of ``sigma`` from ``seed``, which is what
    is stated. NaN of the truth is neither lit nor seen. Raw and filtered points are the same.
    """

    def made(
        specimen: Specimen,
        true: np.ndarray,
        errors: np.ndarray | float = 0.0,
        seed: int = 0,
        sigma: float = SIGMA_MM,
        points: np.ndarray | None = None,
        scale_sd: float = 0.0,
        pixel: float = 0.0099,
        phase_map: Any = None,
    ) -> Artefact:
        world = true + SHIFT[:3, 3]
        xyz = (true if points is None else points) + SHIFT[:3, 3]
        xyz[..., 2] += errors + sigma * np.random.default_rng(seed).standard_normal(true.shape[:2])
        noise = np.zeros(true.shape, dtype=np.float32)
        noise[..., 2] = sigma
        seen = np.isfinite(true[..., 2])
        found = PointMap(xyz, noise, uncertainty(scale_sd, pixel))
        truth = SimpleNamespace(xyz_world=world, lit_and_seen=seen)
        treated = (Treated("none", "", found), Treated("filter", "_filtered", found))
        return Artefact(specimen, SHIFT, truth, phase_map, treated, seen)

    return made


@pytest.fixture
def by_name() -> Callable[..., dict[str, Row]]:
    """Rows by their names, no two of them equal."""

    def found(rows) -> dict[str, Row]:
        rows = list(rows)
        names = {row.name: row for row in rows}
        assert len(names) == len(rows)
        return names

    return found


@pytest.fixture
def grid() -> Callable[[float, float, float], tuple[np.ndarray, np.ndarray]]:
    """x and y (rows, cols) of pixels over width x height mm around the middle, row 0 at the top."""

    def made(width: float, height: float, pixel: float) -> tuple[np.ndarray, np.ndarray]:
        x = np.arange(-width / 2, width / 2, pixel) + pixel / 2
        y = np.arange(height / 2, -height / 2, -pixel) - pixel / 2
        along, down = np.meshgrid(x, y)
        return along, down

    return made
