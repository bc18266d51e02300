"""The paper's procedure from beginning to end on the twin: calibrate, measure, compare, and judge the claims."""

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TypeVar

from greenough.instrument.files import make_folder
from greenough.pipeline import acquisition
from greenough.pipeline.calibration import Calibration, Method
from greenough.pipeline.unfinished import Unfinished

from ..rig import open as open_twin
from . import coarse_stage
from .balls import ball_claims
from .claims import Claim, write_claims
from .noise import measure_plane, noise_claims
from .pitch import MeasuredBoard, measure_boards, pitch_claims
from .report import write_report
from .setup import Setup
from .specimen_maps import SpecimenMaps, specimen_maps
from .specimens import DECONVOLVED, RAW, SPECIMENS, measure_specimen, specimen_claims
from .step import step_claims
from .verdict import verdict_of
from .volume import PLANES, measure_volume, volume_claims

CALIBRATION_RUN = "demo calibration"
MEASUREMENT_RUN = "demo measurement"
"""Runs do not share exposures, so the measurements' noise is not the calibration's."""

REPROJECTION_LIMITS_PX = (0.072, 0.086)  # the paper's
SPOTS_ESTIMATED_LIMIT_PX = 0.015

Advance = Callable[[float], None]
T = TypeVar("T")


def steps(rig_name: str, overrides: Sequence[str]) -> int:
    """How many equal steps of progress a demo takes, roughly a second each."""
    rig, _ = open_twin(rig_name, overrides)
    own = rig.procedure.postures + rig.procedure.planes + 1 + PLANES + 4 * len(SPECIMENS) + 6
    return own + coarse_stage.steps(rig)


def demonstrate(rig_name: str, overrides: Sequence[str], folder: Path, advance: Advance) -> list[Claim]:
    """Run the whole demo and leave its files in ``folder``.

    Both calibrations are made from the same exposures, and every measurement is evaluated by both. ``claims.json``,
    ``calibration.h5`` (the bundle's) and ``calibration-paper.h5``, ``report.html`` with its figures in ``figures``, and
    the clouds and meshes of ``measure_specimen``. An interrupted calibration goes on where it stopped; a finished one
    of the same rig and settings is made again.

    Raises
    ------
    InputError
        If the rig is not a twin, its settings are refused, or ``folder`` cannot be written in.
    """
    make_folder(folder)
    calibrations = _calibrate(rig_name, overrides, folder, advance)
    rig, bench = open_twin(rig_name, overrides, run=MEASUREMENT_RUN)
    setups = [Setup(rig, bench, calibration) for calibration in calibrations]
    with rig:
        claims = [claim for setup in setups for claim in _calibration_claims(setup)]
        planes = measure_plane(setups)
        claims += _each(noise_claims, setups, planes)
        advance(2)
        claims += _each(volume_claims, setups, measure_volume(setups, advance))
        claims += step_claims(setups)
        advance(2)
        boards: list[MeasuredBoard] = []
        for board in measure_boards(setups):
            claims += pitch_claims(setups, board)
            boards.append(board)
        advance(2)
        maps: list[SpecimenMaps] = []
        for name in SPECIMENS:
            measured = measure_specimen(setups, name, folder)
            for setup, found in measured:
                claims += specimen_claims(setup, found)
                if name == "bga":
                    claims += ball_claims(setup, found)
            shown = (found for setup, found in measured if setup is setups[0] and found.treatment in (RAW, DECONVOLVED))
            maps += [specimen_maps(setups[0], found) for found in shown]
            advance(4)
    paper = next(setup.calibration for setup in setups if setup.believes_stage)
    claims += coarse_stage.coarse_stage_claims(rig_name, overrides, paper, advance)
    facts = {"rig": rig_name, "settings": list(overrides)}
    write_claims(folder / "claims.json", claims, facts, verdict_of(claims).plain)
    write_report(folder / "report.html", claims, setups[0], planes[0], boards[0], maps, facts, folder / "figures")
    return claims


def _calibrate(rig_name: str, overrides: Sequence[str], folder: Path, advance: Advance) -> list[Calibration]:
    outs: dict[Method, Path] = {"bundle": folder / "calibration.h5", "paper": folder / "calibration-paper.h5"}
    done = Unfinished.beside(outs["bundle"]).exposures
    rig, _ = open_twin(rig_name, overrides, run=CALIBRATION_RUN, exposures_done=done)
    with rig:
        return list(acquisition.calibrate_by_methods(rig, outs, CALIBRATION_RUN, advance).values())


def _each(
    claims: Callable[[Setup, T], Iterator[Claim]], setups: Sequence[Setup], measured: Sequence[T]
) -> Iterator[Claim]:
    """The rows of every calibration, one calibration after the other."""
    for setup, found in zip(setups, measured, strict=True):
        yield from claims(setup, found)


def _calibration_claims(setup: Setup) -> Iterator[Claim]:
    figures = setup.calibration.figures
    paper_method = setup.believes_stage
    board = "nominal board" if paper_method else "spots estimated"
    for axis, paper, limit in zip("uv", (0.07206, 0.08591), REPROJECTION_LIMITS_PX, strict=True):
        yield setup.claim(
            f"reprojection_rmse_{axis}", "board", figures[f"reprojection_rmse_{axis}_px"], "px",
            figures["spots_used"], f"root mean square over all spots and postures, {board}", paper=paper,
            limit=limit if paper_method else SPOTS_ESTIMATED_LIMIT_PX,
        )  # fmt: skip
