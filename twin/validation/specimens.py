"""Claims about the paper's specimens: each measured, compared with the mesh that was rendered, and kept as files."""

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from greenough.instrument.contract import Placement
from greenough.pipeline.acquisition import deconvolved, measure_phase
from greenough.pipeline.compare import Surface, error_row, vertical_errors
from greenough.pipeline.decode import PhaseMap
from greenough.pipeline.phasor_filter import filter_phasors
from greenough.pipeline.point_cloud import Mesh, PointCloud, write_cloud, write_mesh
from greenough.pipeline.reconstruct import PointMap
from greenough.scenes.parts import merge

from ..bench import Truth
from .claims import Claim
from .evaluation import smooth
from .measured import (
    BIAS_LIMIT_UM,
    DECONVOLVED,
    DECONVOLVED_FILTERED,
    FILTERED,
    P95_LIMIT_UM,
    RAW,
    SHINY,
    VALID_SHARE_LIMIT,
    Measured,
    filter_name,
    has_limits,
    noise_quantile,
    with_noise,
)
from .setup import Setup

SPECIMENS = ("coin", "bga", "diaphragm-concave", "diaphragm-equilibrated", "diaphragm-raised")

WALLED = ("bga",)  # no limit holds for the walls of its balls; `balls` has rows for what can be measured


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
    surface = Surface.of(mesh)
    _ = surface.scene  # made once, before several threads ask for it

    def evaluated(setup: Setup, treatment: str, treated: PhaseMap, points: PointMap) -> Measured:
        method = "" if setup is first else f"-{setup.calibration.method}"
        ending = "" if treatment == RAW else f"-{treatment.replace('_', '-')}"
        cloud = _cloud(setup, name, treatment, points, truth, judged)
        write_cloud(folder / f"{name}{method}{ending}.ply", cloud)
        return Measured(
            name=name,
            treatment=treatment,
            background=phase_map.background,
            points=points,
            height_sigma=setup.height_sigma(treated),
            truth=truth,
            smooth=judged,
            error=error_row("vertical", "smooth", vertical_errors(points.xyz[judged & points.valid], surface)),
            valid_share=len(cloud.xyz) / max(1, int(truth.lit_and_seen.sum())),
        )

    # Evaluating one treatment takes one core, while the next is prepared.
    with ThreadPoolExecutor(2) as pool:
        jobs = [
            (setup, pool.submit(evaluated, setup, treatment, treated, setup.points(treated)))
            for setup in setups
            for treatment, treated in _treated(setup, phase_map, name in SHINY, all_of_them=setup is first)
        ]
        return [(setup, job.result()) for setup, job in jobs]


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


def _cloud(setup: Setup, name: str, treatment: str, points: PointMap, truth: Truth, judged: np.ndarray) -> PointCloud:
    # Valid points that truth does not call lit and seen stay out of cloud, rows and valid share.
    facts = {
        "unit": "mm",
        "specimen": name,
        "calibration": setup.calibration.method,
        "filter": filter_name(setup, treatment),
        "lit_and_seen": int(truth.lit_and_seen.sum()),
        "seed": setup.bench.settings.seed,
    }
    return PointCloud.from_point_map(_only(points, truth.lit_and_seen), judged, facts)


def specimen_claims(setup: Setup, measured: Measured) -> Iterator[Claim]:
    """Bias, spread and coverage of one specimen on its smooth surface, unaligned.

    Beside the spread stands what the frames' noise alone makes of it: the more is measured, the more blur,
    interreflections and the calibration have added.
    """
    suffix, filter = measured.suffix, filter_name(setup, measured.treatment)
    limited = has_limits(setup, measured) and measured.name not in WALLED
    row = measured.error
    sigma = 1e3 * measured.height_sigma[measured.smooth & measured.points.valid]
    noise = float(np.sqrt(np.mean(sigma**2))) if len(sigma) else float("nan")
    rmse = with_noise("root mean square vertical error where the surface is smooth", noise)
    p95 = with_noise("95 % of the vertical errors where it is smooth", noise_quantile(sigma))
    for name, value, limit, criterion in (
        ("bias", row.bias_um, BIAS_LIMIT_UM, "mean vertical error where the surface is smooth"),
        ("rmse", row.rmse_um, None, rmse),
        ("p95", row.p95_um, P95_LIMIT_UM, p95),
    ):
        yield setup.claim(
            name + suffix, measured.name, value, "um", row.n, criterion, limit=limit if limited else None,
            filter=filter,
        )  # fmt: skip
    yield setup.claim(
        "valid_share" + suffix, measured.name, measured.valid_share, "1", int(measured.truth.lit_and_seen.sum()),
        "points among the pixels that are lit and seen", limit=VALID_SHARE_LIMIT if limited else None, at_least=True,
        filter=filter,
    )  # fmt: skip


def _only(points: PointMap, where: np.ndarray) -> PointMap:
    return PointMap(np.where(where[..., None], points.xyz, np.nan))
