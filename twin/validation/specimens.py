"""Claims about the paper's specimens: each measured, compared with the mesh that was rendered, and kept as files."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from greenough.instrument.contract import Placement
from greenough.pipeline.acquisition import measure_phase
from greenough.pipeline.compare import Comparison, compare
from greenough.pipeline.point_cloud import Mesh, PointCloud, write_cloud, write_mesh
from greenough.pipeline.reconstruct import PointMap
from greenough.scenes.parts import merge

from ..bench import Truth
from .claims import Claim
from .evaluation import smooth
from .setup import Setup

SPECIMENS = ("coin", "bga", "diaphragm-concave", "diaphragm-equilibrated", "diaphragm-raised")
OUTLIER_MM = 0.05
"""A cap of 15 degrees is 9 um high: what lies farther than this from its median was not seen in direct light."""

APEX_FILTER = f"paraboloid over 15 degrees, without points beyond {OUTLIER_MM:g} mm of their median"
SHINY = ("coin", "bga")  # metal and solder: several exposures are merged


@dataclass(frozen=True, eq=False)
class Measured:
    """One specimen: its picture, its points, the truth of each pixel, and the comparison of both."""

    name: str
    background: np.ndarray  # (rows, cols) DN
    points: PointMap
    truth: Truth
    smooth: np.ndarray  # (rows, cols) bool
    comparison: Comparison


def measure_specimen(setups: Sequence[Setup], name: str, folder: Path) -> list[Measured]:
    """Measure one specimen, evaluate it by every calibration, and leave clouds and mesh, all in the calibrated frame.

    The first calibration's cloud is ``NAME.ply``, those of others are ``NAME-METHOD.ply``; the mesh is
    ``NAME-truth.ply``.
    """
    first = setups[0]
    brackets = first.calibration.procedure.brackets if name in SHINY else (1.0,)
    phase_map = measure_phase(first.rig, first.calibration, Placement(name), brackets)
    truth = first.bench.truth()
    judged = smooth(truth, first.airy_radius_px) & truth.lit_and_seen
    mesh = Mesh(*merge(first.bench.parts_in_world()))
    write_mesh(folder / f"{name}-truth.ply", mesh, {"unit": "mm", "specimen": name})
    measured = []
    for setup in setups:
        suffix = "" if setup is first else f"-{setup.calibration.method}"
        points = setup.points(phase_map)
        cloud = _cloud(setup, name, points, truth, judged)
        write_cloud(folder / f"{name}{suffix}.ply", cloud)
        measured.append(Measured(name, phase_map.background, points, truth, judged, compare(cloud, mesh)))
    return measured


def _cloud(setup: Setup, name: str, points: PointMap, truth: Truth, judged: np.ndarray) -> PointCloud:
    # Valid points that truth does not call lit and seen stay in the cloud, and out of the rows and the valid share.
    facts = {
        "unit": "mm",
        "specimen": name,
        "calibration": setup.calibration.method,
        "filter": "none",
        "lit_and_seen": int(truth.lit_and_seen.sum()),
        "seed": setup.bench.settings.seed,
    }
    return PointCloud.from_point_map(_only(points, truth.lit_and_seen), judged, facts)


def specimen_claims(setup: Setup, measured: Measured) -> Iterator[Claim]:
    """Bias, spread and coverage of one specimen on its smooth surface, unaligned and unfiltered."""
    row = measured.comparison.row("vertical", "smooth")
    for name, value, criterion in (
        ("bias", row.bias_um, "mean vertical error where the surface is smooth"),
        ("rmse", row.rmse_um, "root mean square vertical error where the surface is smooth"),
        ("p95", row.p95_um, "95 % of the vertical errors where the surface is smooth"),
    ):
        yield setup.claim(name, measured.name, value, "um", row.n, criterion)
    lit_and_seen = int(measured.truth.lit_and_seen.sum())
    share = measured.comparison.valid_share
    assert share is not None
    yield setup.claim(
        "valid_share", measured.name, share, "1", lit_and_seen, "points among the pixels that are lit and seen"
    )


def ball_claims(setup: Setup, measured: Measured) -> Iterator[Claim]:
    """Heights of the balls' apexes against truth: the points within 15 degrees of the top, about their sphere."""
    built = setup.bench.specimen.as_built
    motion = setup.bench.world_from_part
    apexes = built["ball_apexes_mm"] @ motion[:3, :3].T + motion[:3, 3]
    radii = built["ball_radii_mm"]
    xyz = measured.points.xyz[measured.points.valid]
    errors = []
    for apex, radius in zip(apexes, radii, strict=True):
        near = xyz[np.hypot(*(xyz[:, :2] - apex[:2]).T) < radius * np.sin(np.radians(15))]
        if len(near) == 0:
            continue
        near = near[np.abs(near[:, 2] - np.median(near[:, 2])) < OUTLIER_MM]
        if len(near) < 6:
            continue
        # A paraboloid of free height, place and curvature: its top is the apex.
        x, y = (near[:, :2] - apex[:2]).T
        design = np.column_stack([np.ones_like(x), x, y, x * x + y * y])
        c, a, b, k = np.linalg.lstsq(design, near[:, 2], rcond=None)[0]
        errors.append(c - (a * a + b * b) / (4 * k) - apex[2])
    if len(errors) < 2:
        return
    error = np.array(errors)
    for name, value, criterion in (
        ("ball_apex_bias", np.mean(error), "mean error of the apex heights"),
        ("ball_apex_sd", np.std(error, ddof=1), "standard deviation of the apex heights' errors over the balls"),
    ):
        yield setup.claim(name, measured.name, 1e3 * float(value), "um", len(error), criterion, filter=APEX_FILTER)
    worst = 1e3 * float(np.abs(error).max())
    yield setup.claim(
        "ball_apex_within_tolerance", measured.name, worst, "um", len(error),
        "largest error of an apex height stays below the drawing's tolerance", paper=50.0, limit=50.0,
        filter=APEX_FILTER,
    )  # fmt: skip


def _only(points: PointMap, where: np.ndarray) -> PointMap:
    return PointMap(np.where(where[..., None], points.xyz, np.nan))
