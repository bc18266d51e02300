"""The paper's procedure from beginning to end on the twin: calibrate, measure, compare, and print the claims."""

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from greenough.pipeline import acquisition
from greenough.pipeline.calibration import Calibration
from greenough.pipeline.unfinished import Unfinished

from ..rig import open as open_twin
from .claims import Claim, write_claims
from .pitch import pitch_claims
from .planes import VOLUME_HEIGHTS_MM, measure_plane, noise_claims, step_claims, volume_claims
from .report import SpecimenMaps, specimen_maps, write_report
from .setup import Setup
from .specimens import SPECIMENS, ball_claims, measure_specimen, specimen_claims

CALIBRATION_RUN = "demo calibration"
MEASUREMENT_RUN = "demo measurement"
"""Runs do not share exposures, so the measurements' noise is not the calibration's."""

REPROJECTION_LIMITS_PX = (0.072, 0.086)  # the paper's

Advance = Callable[[float], None]


def steps(rig_name: str, overrides: Sequence[str]) -> int:
    """How many equal steps of progress a demo takes, roughly a second each."""
    rig, _ = open_twin(rig_name, overrides)
    return rig.procedure.postures + rig.procedure.planes + 1 + len(VOLUME_HEIGHTS_MM) + 4 * len(SPECIMENS) + 6


def demonstrate(rig_name: str, overrides: Sequence[str], folder: Path, advance: Advance) -> list[Claim]:
    """Run the whole demo and leave its files in ``folder``.

    ``claims.json``, ``calibration.h5``, ``report.html``, and for each specimen ``NAME.ply`` and ``NAME-truth.ply``.
    An interrupted calibration goes on where it stopped; a finished one of the same rig and settings is made again.

    Raises
    ------
    InputError
        If the rig is not a twin, or its settings are refused.
    """
    folder.mkdir(parents=True, exist_ok=True)
    calibration = _calibrate(rig_name, overrides, folder / "calibration.h5", advance)
    rig, bench = open_twin(rig_name, overrides, run=MEASUREMENT_RUN)
    setup = Setup(rig, bench, calibration)
    with rig:
        claims = [*_calibration_claims(setup)]
        plane = measure_plane(setup)
        claims += noise_claims(setup, plane)
        advance(2)
        claims += volume_claims(setup, advance)
        claims += step_claims(setup)
        advance(2)
        claims += pitch_claims(setup)
        advance(2)
        maps: list[SpecimenMaps] = []
        for name in SPECIMENS:
            measured = measure_specimen(setup, name, folder)
            claims += specimen_claims(setup, measured)
            if name == "bga":
                claims += ball_claims(setup, measured)
            maps.append(specimen_maps(measured))
            advance(4)
    facts = {"rig": rig_name, "settings": list(overrides)}
    write_claims(folder / "claims.json", claims, facts)
    write_report(folder / "report.html", claims, setup, plane, maps, facts)
    return claims


def _calibrate(rig_name: str, overrides: Sequence[str], out: Path, advance: Advance) -> Calibration:
    done = Unfinished.beside(out).exposures
    rig, _ = open_twin(rig_name, overrides, run=CALIBRATION_RUN, exposures_done=done)
    with rig:
        return acquisition.calibrate(rig, out, CALIBRATION_RUN, advance)


def _calibration_claims(setup: Setup) -> Iterator[Claim]:
    figures = setup.calibration.figures
    for axis, paper, limit in zip("uv", (0.07206, 0.08591), REPROJECTION_LIMITS_PX, strict=True):
        yield setup.claim(
            f"reprojection_rmse_{axis}", "board", figures[f"reprojection_rmse_{axis}_px"], "px",
            figures["spots_used"], "root mean square over all spots and postures, nominal board", paper=paper,
            limit=limit,
        )  # fmt: skip
