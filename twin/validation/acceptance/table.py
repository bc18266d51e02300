"""The whole acceptance: calibrate, lay every artefact under the lenses, and write one table."""

import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from greenough.instrument.errors import FileError, InputError
from greenough.instrument.files import atomic_path, check_file
from greenough.pipeline import acquisition
from greenough.pipeline.calibration import Calibration
from greenough.pipeline.unfinished import Unfinished

from ...rig import open as open_twin
from ..claims import environment
from ..judged_table import JudgedTable
from ..measured_noise import STEADY
from ..setup import Setup
from . import ball_grid, diaphragm, flatness, mapping, noise, resolution, spheres, steps
from .rows import Row
from .verdict import ArtefactLine, artefact_lines, plain

CALIBRATION_RUN = "acceptance calibration"
MEASUREMENT_RUN = "acceptance"
"""Runs do not share exposures, so the measurements' noise is not the calibration's."""

Advance = Callable[[float], None]


@dataclass(frozen=True)
class Instrument:
    """One calibrated instrument: as it is, and without what moves whole pictures from frame to frame."""

    as_it_is: Setup
    steady: Setup


@dataclass(frozen=True)
class Group:
    """Rows that are measured together.

    Parameters
    ----------
    names : tuple of str
        Of all rows that must come.
    captures : int
        How often ``rows`` calls ``advance`` with 1.
    rows : callable
        Measures and judges.
    headline : str
        The row that stands for all of them in a verdict; the first one where none is named.
    """

    names: tuple[str, ...]
    captures: int
    rows: Callable[[Instrument, Advance], Iterator[Row]]
    headline: str = ""


GROUPS: Mapping[str, Group] = {
    "sphere": Group(spheres.PROBING_NAMES, 1, lambda its, advance: spheres.probing_rows(its.as_it_is, advance)),
    "two spheres": Group(
        spheres.SPACING_NAMES,
        len(spheres.SPACING_PLACES),
        lambda its, advance: spheres.spacing_rows(its.as_it_is, advance),
        "sphere_spacing_largest",
    ),
    "plane": Group(
        flatness.NAMES,
        len(flatness.PLACES),
        lambda its, advance: flatness.flatness_rows(its.as_it_is, advance),
        "flatness_95_largest",
    ),
    "step gauge": Group(steps.NAMES, 1, lambda its, advance: steps.step_rows(its.as_it_is, advance), "step_largest"),
    "cross grating": Group(mapping.NAMES, 1, lambda its, advance: mapping.mapping_rows(its.as_it_is, advance)),
    "noise": Group(noise.NAMES, noise.PAIRS, lambda its, advance: noise.noise_rows(its.as_it_is, its.steady, advance)),
    "chirp": Group(
        resolution.NAMES,
        len(resolution.TURNED_DEG),
        lambda its, advance: resolution.resolution_rows(its.as_it_is, advance),
    ),
    "ball grid": Group(
        ball_grid.NAMES,
        1,
        lambda its, advance: ball_grid.ball_grid_rows(its.as_it_is, advance),
        "bga_seating_coplanarity",
    ),
    "diaphragm": Group(
        diaphragm.NAMES, len(diaphragm.STATES), lambda its, advance: diaphragm.diaphragm_rows(its.as_it_is, advance)
    ),
}


def captures(rig_name: str, overrides: Sequence[str], calibrated: bool) -> int:
    """How many steps of progress `accept` takes."""
    rig, _ = open_twin(rig_name, overrides)
    calibration = 0 if calibrated else rig.procedure.postures + rig.procedure.planes + 1
    return calibration + sum(group.captures for group in GROUPS.values())


def accept(
    rig_name: str, overrides: Sequence[str], calibration_file: Path | None, out: Path, advance: Advance
) -> JudgedTable[Row]:
    """Measure every artefact with one instrument and write the table to ``out``.

    Parameters
    ----------
    rig_name : str
        A twin: only there are artefacts of which everything is certified.
    overrides : sequence of str
        Settings of its rig file.
    calibration_file : Path or None
        Of this rig. Without, it is calibrated by the bundle first, beside ``out``; an interrupted calibration goes on
        where it stopped.
    out : Path
        JSON; appears whole or not at all.
    advance : callable
        Called with 1 after each of the ``captures``.

    Raises
    ------
    InputError
        If the rig is not a twin, its settings are refused, or the calibration is not its own. What an artefact's
        measurement or evaluation refuses makes its rows missing instead.
    """
    check_file(out)
    if calibration_file is None:
        calibration = _calibrate(rig_name, overrides, out, advance)
    else:
        calibration = Calibration.load(calibration_file)
    rig, bench = open_twin(rig_name, overrides, run=MEASUREMENT_RUN)
    calibration.check_fits(rig.identity, rig.camera.shape)
    still, still_bench = open_twin(rig_name, [*overrides, *STEADY], run=f"{MEASUREMENT_RUN} steady")
    instrument = Instrument(Setup(rig, bench, calibration), Setup(still, still_bench, calibration))
    with rig, still:
        table = judge(instrument, advance)
    _write(out, table, {"rig": rig_name, "settings": list(overrides)})
    return table


def judge(instrument: Instrument, advance: Advance) -> JudgedTable[Row]:
    """The rows of every group, and which of them are missing for what reason."""
    rows: list[Row] = []
    missing: dict[str, str] = {}
    for what, group in GROUPS.items():
        reason = f"the {what} yielded no such row"
        try:
            rows.extend(group.rows(instrument, advance))
        except FileError:
            raise
        except InputError as error:
            reason = f"{what}: {error}"
        found = {row.name for row in rows}
        missing |= {name: reason for name in group.names if name not in found}
    return JudgedTable(tuple(rows), missing)


def verdict_lines(table: JudgedTable[Row]) -> list[ArtefactLine]:
    """The verdict on each artefact."""
    return artefact_lines(
        table,
        {what: group.names for what, group in GROUPS.items()},
        {what: group.headline for what, group in GROUPS.items() if group.headline},
    )


def _calibrate(rig_name: str, overrides: Sequence[str], out: Path, advance: Advance) -> Calibration:
    file = out.with_name(f"{out.stem}-calibration.h5")
    done = Unfinished.beside(file).exposures
    rig, _ = open_twin(rig_name, overrides, run=CALIBRATION_RUN, exposures_done=done)
    with rig:
        return acquisition.calibrate(rig, file, CALIBRATION_RUN, advance)


def _write(out: Path, table: JudgedTable[Row], facts: Mapping[str, Any]) -> None:
    rows = [{name: _or_none(value) for name, value in asdict(row).items()} for row in table.rows]
    document: dict[str, Any] = {"verdict": plain(verdict_lines(table))}
    document |= {"rows": rows, "missing": dict(table.missing), "environment": environment() | dict(facts)}
    with atomic_path(out) as temporary:
        temporary.write_text(json.dumps(document, indent=1, allow_nan=False, ensure_ascii=False), encoding="utf-8")


def _or_none(value: Any) -> Any:
    return None if isinstance(value, float) and not math.isfinite(value) else value
