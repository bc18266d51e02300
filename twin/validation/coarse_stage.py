"""What the paper's method makes of a stage of 10 µm: the figure that the paper's own stage has.

A second twin differs from the one under test in its stage alone, and in pixels that are as coarse as the errors allow
that are looked for: four by four of a full camera in one. Only the planes are captured again: the postures, and with
them the camera, do not use the stage.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.polynomial import chebyshev

from greenough.instrument.contract import BLANK, Placement, Rig
from greenough.instrument.rigfile import load_rig_file
from greenough.pipeline.acquisition import plane_phase
from greenough.pipeline.calibration import Calibration
from greenough.pipeline.camera_model import CameraModel
from greenough.pipeline.decode import decode
from greenough.pipeline.paper_method import fit_planes
from greenough.pipeline.rays import rays_of_camera

from ..bench import Bench
from ..rig import open as open_twin
from ..settings import twin_settings
from ..workbench import Workbench
from .claims import Claim
from .mechanics import DEGREE, field_grid, systematic_error
from .setup import Setup
from .volume import PLANES, depth_claims, measure_volume

POSITION_SD_UM = 10.0
RUN = "demo with a coarse stage"
MEASUREMENT_RUN = "demo measurement with a coarse stage"
HEIGHTS_MM = (-1.4, -1.0, -0.5, 0.0, 0.5, 1.0, 1.4)
"""Stage positions of the flat planes: three standard deviations of the stage's error, there and at the calibration's
planes, inside the 1.45 mm of the outermost of these, so that no plane is cut where its errors are large."""
INSTRUMENTS = 40  # drawn for the share of them that keeps the limit: enough to tell a tenth from a half
LIMIT_UM = 4.0
COLS = 320  # of the coarse camera, at least: the finest fringes still span five pixels
_STAGES = 2000  # with independent errors: a share of a tenth is known to 0.7 %
SHARE_LIMIT = 0.95  # of instruments that would have to keep it, were such a stage enough


def steps(rig: Rig) -> int:
    """How many planes are captured."""
    return 1 + rig.procedure.planes + PLANES


def coarse_stage_claims(
    rig_name: str,
    overrides: Sequence[str],
    paper: Calibration,
    advance: Callable[[float], None],
    position_sd_um: float = POSITION_SD_UM,
) -> Iterator[Claim]:
    """Depth errors over the volume, beside what the stage as built predicts, and what other such stages would make.

    Parameters
    ----------
    rig_name, overrides
        Of the twin under test.
    paper : Calibration
        Its calibration by the paper's method.
    advance : callable
        Called with 1 after each of the planes.
    position_sd_um : float
        Of the stages.
    """
    n = _binning(paper.camera.shape)
    coarse = [*overrides, f"twin.stage.position_sd_um={position_sd_um:g}", *_coarse_pixels(rig_name, overrides, n)]
    rig, bench = open_twin(rig_name, coarse, run=RUN)
    with rig:
        calibration = _calibrated(Setup(rig, bench, _in_coarse_pixels(paper, n)), advance)
    # The same instrument in a run of its own: what drifts is not that of the calibration.
    rig, bench = open_twin(rig_name, coarse, run=MEASUREMENT_RUN)
    with rig:
        setup = Setup(rig, bench, calibration)
        (planes,) = measure_volume([setup], advance, HEIGHTS_MM)
    specimen = f"plane, stage of {position_sd_um:g} um"
    for claim in depth_claims(setup, planes):
        yield replace(claim, specimen=specimen)
    others = np.array(list(predicted_percentiles(rig_name, coarse, setup.readings)))
    of = f"depth_p95_volume of {len(others)} other instruments, predicted from stage and board as drawn, without frames"
    yield setup.claim(
        "stages_within_4um", specimen, float(np.mean(others <= LIMIT_UM)), "1", len(others),
        f"share within 4 um, at least {SHARE_LIMIT:g} if such a stage were enough: {of}", limit=SHARE_LIMIT,
        at_least=True, predicted=independent_errors_share(setup.readings, position_sd_um),
    )  # fmt: skip
    yield setup.claim("stages_median_p95", specimen, float(np.median(others)), "um", len(others), f"median: {of}")


def predicted_percentiles(rig_name: str, overrides: Sequence[str], readings: np.ndarray) -> Iterator[float]:
    """95 % of the vertical errors over the volume by the paper's method, µm, of ``INSTRUMENTS`` other instruments.

    From their stages and boards as they are drawn, without drift, noise, or a frame.
    """
    rig_file = load_rig_file(rig_name, overrides)
    settings, places = twin_settings(rig_file), field_grid()[::7]
    for k in range(1, INSTRUMENTS + 1):
        other = settings.model_copy(update={"seed": settings.seed + k})
        bench = Bench(rig_file, other, Workbench(rig_file, other))
        error = systematic_error(bench, readings, np.array(HEIGHTS_MM), places)
        yield 1e3 * float(np.percentile(np.abs(error), 95))


def independent_errors_share(readings: np.ndarray, position_sd_um: float = POSITION_SD_UM) -> float:
    """Share of stages within ``LIMIT_UM`` whose heights err by independent normal deviates, under a flat board.

    A cubic through the planes takes their errors for heights, and the origin is where the stage stood at 0.
    """
    rng, scale = np.random.default_rng(0), np.abs(readings).max()
    planes, zero = (rng.normal(0, position_sd_um, (_STAGES, n)) for n in (len(readings), 1))
    powers, at_zero, there = (
        chebyshev.chebvander(np.asarray(z) / scale, DEGREE) for z in (readings, [0.0], HEIGHTS_MM)
    )
    relations = planes @ np.linalg.pinv(powers).T  # (stages, coefficients)
    error = relations @ at_zero.T - relations @ there.T - zero
    return float(np.mean(np.percentile(np.abs(error), 95, axis=1) <= LIMIT_UM))


def binned(camera: CameraModel, n: int) -> CameraModel:
    """The same camera with n x n of its pixels in one, whose centre is theirs."""
    middle = (n - 1) / 2
    rows, cols = camera.shape
    return replace(
        camera, fx=camera.fx / n, fy=camera.fy / n, skew=camera.skew / n, cx=(camera.cx - middle) / n,
        cy=(camera.cy - middle) / n, shape=(rows // n, cols // n),
    )  # fmt: skip


def _binning(shape: tuple[int, int]) -> int:
    """The most pixels in one, along either side, that leave ``COLS`` and divide the picture."""
    rows, cols = shape
    return next((n for n in range(cols // COLS, 1, -1) if rows % n == cols % n == 0), 1)


def _coarse_pixels(rig_name: str, overrides: Sequence[str], n: int) -> list[str]:
    """Settings of the twin whose camera is ``binned``."""
    rig_file = load_rig_file(rig_name, overrides)
    rows, cols = rig_file.camera.shape
    focal = twin_settings(rig_file).optics.camera_focal_px
    return [f"camera.rows={rows // n}", f"camera.cols={cols // n}", f"twin.optics.camera_focal_px={focal / n!r}"]


def _in_coarse_pixels(paper: Calibration, n: int) -> Calibration:
    """The calibration's camera in the same pixels; its relation is to be made anew."""
    camera = binned(paper.camera, n)
    v, u = ((grid - (n - 1) / 2) / n for grid in (paper.uncertainty.grid_v_px, paper.uncertainty.grid_u_px))
    return replace(
        paper, camera=camera, rays=rays_of_camera(camera, paper.camera_from_world),
        uncertainty=replace(paper.uncertainty, grid_v_px=v, grid_u_px=u),
    )  # fmt: skip


def _calibrated(setup: Setup, advance: Callable[[float], None]) -> Calibration:
    """The setup's calibration with a relation from planes of its own stage."""
    rig, fringes = setup.rig, setup.calibration.fringes
    patterns = fringes.patterns(*rig.projector.shape)
    setup.place(Placement("board", face=BLANK))
    phases, exposures = [], 0
    for height in (0.0, *setup.readings):
        rig.stage.move_to_mm(height)
        frames = rig.capture(patterns)
        phases.append(plane_phase(decode(frames, fringes, rig.camera.noise)))
        exposures = int(frames.serials[-1]) + 1
        advance(1)
    fit, _ = fit_planes(phases[0], np.stack(phases[1:]), setup.readings)
    return replace(setup.calibration, phase_height=fit.relation, run=RUN, exposures=exposures)
