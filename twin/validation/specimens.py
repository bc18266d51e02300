"""Claims about the paper's specimens: each measured, compared with the mesh that was rendered, and kept as files."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from greenough.instrument.contract import Placement
from greenough.pipeline.acquisition import deconvolved, measure_phase
from greenough.pipeline.compare import Comparison, compare
from greenough.pipeline.decode import PhaseMap
from greenough.pipeline.phasor_filter import filter_phasors
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

RAW, FILTERED, DECONVOLVED, DECONVOLVED_FILTERED = "raw", "filtered", "deconvolved", "deconvolved_filtered"
"""What is done to a phase map. Names of its rows and clouds end so, unless nothing is."""

APEX_FILTER = f"paraboloid over 15 degrees, without points beyond {OUTLIER_MM:g} mm of their median"
SHINY = ("coin", "bga")  # metal and solder: several exposures are merged


@dataclass(frozen=True, eq=False)
class Measured:
    """One specimen: its picture, its points, the truth of each pixel, and the comparison of both."""

    name: str
    treatment: str  # what was done to the phase
    background: np.ndarray  # (rows, cols) DN
    points: PointMap
    truth: Truth
    smooth: np.ndarray  # (rows, cols) bool
    comparison: Comparison


def measure_specimen(setups: Sequence[Setup], name: str, folder: Path) -> list[tuple[Setup, Measured]]:
    """Measure one specimen, evaluate it by every calibration, and leave clouds and mesh, all in the calibrated frame.

    The first calibration's cloud is ``NAME.ply``, those of others are ``NAME-METHOD.ply``; the mesh is
    ``NAME-truth.ply``. By the first calibration metal and solder are also deconvolved, without and with the one filter,
    and the others filtered: names of these clouds end with ``-deconvolved``, ``-deconvolved-filtered``, ``-filtered``.
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
        for treatment, treated in _treated(setup, phase_map, name in SHINY, all_of_them=setup is first):
            method = "" if setup is first else f"-{setup.calibration.method}"
            ending = "" if treatment == RAW else f"-{treatment.replace('_', '-')}"
            points = setup.points(treated)
            cloud = _cloud(setup, name, treatment, points, truth, judged)
            write_cloud(folder / f"{name}{method}{ending}.ply", cloud)
            comparison = compare(cloud, mesh)
            measured.append((setup, Measured(name, treatment, phase_map.background, points, truth, judged, comparison)))
    return measured


def _treated(setup: Setup, phase_map: PhaseMap, shiny: bool, all_of_them: bool) -> Iterator[tuple[str, PhaseMap]]:
    """The phase map as measured, and by turns deconvolved and filtered."""
    yield RAW, phase_map
    if all_of_them:
        if shiny and setup.calibration.point_spread is not None:
            phase_map = deconvolved(phase_map, setup.calibration)
            yield DECONVOLVED, phase_map
            yield DECONVOLVED_FILTERED, filter_phasors(phase_map, setup.filter_fwhm_px)
        else:
            yield FILTERED, filter_phasors(phase_map, setup.filter_fwhm_px)


def _filter_name(setup: Setup, treatment: str) -> str:
    """What a row says was done."""
    names = {
        RAW: "none",
        DECONVOLVED: "deconvolved",
        DECONVOLVED_FILTERED: f"deconvolved, {setup.filter_name}",
        FILTERED: setup.filter_name,
    }
    return names[treatment]


def _cloud(setup: Setup, name: str, treatment: str, points: PointMap, truth: Truth, judged: np.ndarray) -> PointCloud:
    # Valid points that truth does not call lit and seen stay in the cloud, and out of the rows and the valid share.
    facts = {
        "unit": "mm",
        "specimen": name,
        "calibration": setup.calibration.method,
        "filter": _filter_name(setup, treatment),
        "lit_and_seen": int(truth.lit_and_seen.sum()),
        "seed": setup.bench.settings.seed,
    }
    return PointCloud.from_point_map(_only(points, truth.lit_and_seen), judged, facts)


def specimen_claims(setup: Setup, measured: Measured) -> Iterator[Claim]:
    """Bias, spread and coverage of one specimen on its smooth surface, unaligned."""
    suffix, filter = _suffix(measured), _filter_name(setup, measured.treatment)
    row = measured.comparison.row("vertical", "smooth")
    for name, value, criterion in (
        ("bias", row.bias_um, "mean vertical error where the surface is smooth"),
        ("rmse", row.rmse_um, "root mean square vertical error where the surface is smooth"),
        ("p95", row.p95_um, "95 % of the vertical errors where the surface is smooth"),
    ):
        yield setup.claim(name + suffix, measured.name, value, "um", row.n, criterion, filter=filter)
    if measured.treatment != RAW:
        return
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
    suffix, filter = _suffix(measured), APEX_FILTER
    if measured.treatment != RAW:
        filter = f"{_filter_name(setup, measured.treatment)}, {APEX_FILTER}"
    for name, value, criterion in (
        ("ball_apex_bias", np.mean(error), "mean error of the apex heights"),
        ("ball_apex_sd", np.std(error, ddof=1), "standard deviation of the apex heights' errors over the balls"),
    ):
        yield setup.claim(name + suffix, measured.name, 1e3 * float(value), "um", len(error), criterion, filter=filter)
    worst = 1e3 * float(np.abs(error).max())
    yield setup.claim(
        f"ball_apex_within_tolerance{suffix}", measured.name, worst, "um", len(error),
        "largest error of an apex height stays below the drawing's tolerance", paper=50.0, limit=50.0,
        filter=filter,
    )  # fmt: skip


def _suffix(measured: Measured) -> str:
    return "" if measured.treatment == RAW else f"_{measured.treatment}"


def _only(points: PointMap, where: np.ndarray) -> PointMap:
    return PointMap(np.where(where[..., None], points.xyz, np.nan))
