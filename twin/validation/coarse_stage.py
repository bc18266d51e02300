"""What the paper's method makes of a stage of 10 µm: the figure that the paper's own stage has.

A second twin differs from the one under test in its stage alone. Only the planes are captured again: the postures, and
with them the camera, do not use the stage.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from greenough.instrument.contract import BLANK, Placement, Rig
from greenough.instrument.rigfile import load_rig_file
from greenough.pipeline.acquisition import plane_phase
from greenough.pipeline.calibration import Calibration
from greenough.pipeline.decode import decode
from greenough.pipeline.paper_method import fit_planes

from ..bench import Bench
from ..rig import open as open_twin
from ..settings import twin_settings
from ..workbench import Workbench
from .claims import Claim
from .mechanics import field_grid, systematic_error
from .setup import Setup
from .volume import PLANES, VOLUME_HEIGHTS_MM, depth_claims, measure_volume

POSITION_SD_UM = 10.0
RUN = "demo with a coarse stage"
SPECIMEN = f"plane, stage of {POSITION_SD_UM:g} um"
INSTRUMENTS = 40  # drawn for the share of them that keeps the limit: enough to tell a tenth from a half
LIMIT_UM = 4.0


def steps(rig: Rig) -> int:
    """How many planes are captured."""
    return 1 + rig.procedure.planes + PLANES


def coarse_stage_claims(
    rig_name: str, overrides: Sequence[str], paper: Calibration, advance: Callable[[float], None]
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
    """
    coarse = [*overrides, f"twin.stage.position_sd_um={POSITION_SD_UM:g}"]
    rig, bench = open_twin(rig_name, coarse, run=RUN)
    with rig:
        setup = _calibrated(Setup(rig, bench, paper), advance)
        (planes,) = measure_volume([setup], advance)
    for claim in depth_claims(setup, planes):
        yield replace(claim, specimen=SPECIMEN)
    kept = [p95 <= LIMIT_UM for p95 in predicted_percentiles(rig_name, coarse, setup.readings)]
    yield setup.claim(
        "stages_within_4um", SPECIMEN, float(np.mean(kept)), "1", len(kept),
        "share of instruments drawn anew whose depth_p95_volume is predicted within 4 um, without noise",
    )  # fmt: skip


def predicted_percentiles(rig_name: str, overrides: Sequence[str], readings: np.ndarray) -> Iterator[float]:
    """95 % of the vertical errors over the volume by the paper's method, µm, of ``INSTRUMENTS`` other instruments.

    From their stages and boards as they are drawn, without drift, noise, or a frame.
    """
    rig_file = load_rig_file(rig_name, overrides)
    settings, places = twin_settings(rig_file), field_grid()[::7]
    for k in range(1, INSTRUMENTS + 1):
        other = settings.model_copy(update={"seed": settings.seed + k})
        bench = Bench(rig_file, other, Workbench(rig_file, other))
        error = systematic_error(bench, readings, np.array(VOLUME_HEIGHTS_MM), places)
        yield 1e3 * float(np.percentile(np.abs(error), 95))


def _calibrated(setup: Setup, advance: Callable[[float], None]) -> Setup:
    """The setup with a relation from planes of its own stage."""
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
    calibration = replace(setup.calibration, phase_height=fit.relation, run=RUN, exposures=exposures)
    return replace(setup, calibration=calibration)
