"""The verb ``diagnose``: what is wrong with a measurement, what it costs, and what to do."""

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from greenough.instrument.errors import InputError
from greenough.instrument.progress import progress
from greenough.instrument.verbs import JsonOption, output_file, show

from .decode_command import frames_in_order, fringe_set

if TYPE_CHECKING:
    from .diagnosis.finding import Finding
    from .fringes import FringeSet

app = typer.Typer()


@app.command()
def diagnose(
    files: Annotated[
        list[str],
        typer.Argument(
            metavar="FILE|FRAMES...",
            help="A recording or a calibration; or frames as `greenough decode` takes them: images, folders, globs, "
            "or one .npy, .npz or .h5 file with the whole stack.",
        ),
    ],
    periods: Annotated[
        str | None, typer.Option("--periods", help="Fringe periods in columns, of frames that tell none themselves.")
    ] = None,
    steps: Annotated[str | None, typer.Option("--steps", help="Phase steps of each period.")] = None,
    field: Annotated[float | None, typer.Option("--field", help="Lit columns, where no period spans them.")] = None,
    sign: Annotated[int, typer.Option("--sign", help="1 if a step adds to the phase, -1 if it takes from it.")] = 1,
    start_deg: Annotated[float, typer.Option("--start-deg", help="Phase of each first frame on column 0.")] = 0.0,
    fringe_frames: Annotated[
        str | None, typer.Option("--fringe-frames", help="Which frames show fringes, from 0: 3-5,0-2. [default: all]")
    ] = None,
    calibration: Annotated[
        Path | None,
        typer.Option("--calibration", metavar="CAL.h5", help="Of the instrument: tells effects in µm."),
    ] = None,
    lut_out: Annotated[
        Path | None,
        typer.Option(
            "--lut-out",
            metavar="FILE.txt",
            help="Write what to send for the grey values 0 to 255.",
            callback=output_file,
        ),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Say what is wrong with a measurement and what to do.

    Each finding has its cause, its effect in µm and a remedy, the worst first. The exit code is 0 if there is none, and
    1 if there is one.
    """
    from greenough.instrument import hdf5
    from greenough.instrument.frame_files import read_frames
    from greenough.instrument.journal import KIND as RECORDING

    from .calibration import KIND as CALIBRATION
    from .calibration import Calibration
    from .diagnosis.calibrations import diagnose_calibration, yardstick_of
    from .diagnosis.finding import Yardstick, worst_first
    from .diagnosis.recordings import count_sequences, diagnose_recording
    from .diagnosis.sequence import sequence_of
    from .diagnosis.sequences import diagnose_sequence

    loaded = None if calibration is None else Calibration.load(calibration)
    kind = hdf5.kind_of(files[0]) if len(files) == 1 else None
    facts: dict[str, object] = {"input": files[0] if len(files) == 1 else f"{files[0]} ... {files[-1]}"}
    if kind == RECORDING:
        path, fringes = Path(files[0]), _given(periods, steps, field, sign, start_deg)
        with progress(count_sequences(path, fringes), "diagnosing", quiet=as_json) as advance:
            of_recording = diagnose_recording(path, fringes, loaded, advance)
        found, yardstick = of_recording.findings, of_recording.yardstick
        facts |= {"kind": RECORDING, "sequences": of_recording.sequences}
    elif kind == CALIBRATION:
        loaded = Calibration.load(files[0])
        found, yardstick = diagnose_calibration(loaded), yardstick_of(loaded)
        facts |= {"kind": CALIBRATION}
    elif kind is not None and kind.startswith("greenough"):
        raise InputError(f"{files[0]} is a {kind}: give the recording, the calibration or the frames that it came from")
    else:
        if periods is None or steps is None:
            raise InputError("frames do not tell what was projected: give --periods and --steps")
        fringes = fringe_set(periods, steps, field, sign, start_deg)
        read = read_frames(files)
        order, reason = frames_in_order(read, periods, steps, fringe_frames)
        yardstick = Yardstick() if loaded is None else yardstick_of(loaded)
        found = diagnose_sequence(sequence_of("frames", read.stack[order], fringes), yardstick)
        facts |= {"kind": "frames", "sequences": 1, "order": reason}
    findings = worst_first(found)
    facts |= {"um_per_rad": yardstick.um_per_rad, "least_effect_rad": yardstick.least_rad}
    if lut_out is not None:
        _write_table(lut_out, findings)
    _show(facts, findings, as_json)
    if findings:
        raise typer.Exit(1)


def _given(
    periods: str | None, steps: str | None, field: float | None, sign: int, start_deg: float
) -> "FringeSet | None":
    if periods is None and steps is None:
        return None
    if periods is None or steps is None:
        raise InputError("give --periods and --steps together")
    return fringe_set(periods, steps, field, sign, start_deg)


def _write_table(path: Path, findings: "Sequence[Finding]") -> None:
    from greenough.instrument.files import atomic_path

    from .diagnosis.response import correction_table

    gammas = [finding.evidence["gamma"] for finding in findings if finding.name == "response"]
    if not gammas:
        raise InputError(f"--lut-out {path}: the frames show no bent response, so that there is nothing to correct")
    with atomic_path(path) as temporary:
        temporary.write_text("".join(f"{value}\n" for value in correction_table(float(gammas[0]))), encoding="utf-8")


def _show(facts: dict[str, object], findings: "Sequence[Finding]", as_json: bool) -> None:
    if as_json:
        show({**facts, "findings": [asdict(finding) for finding in findings]}, as_json)
        return
    show({**facts, "findings": len(findings)}, as_json)
    for number, finding in enumerate(findings, start=1):
        entries = asdict(finding)
        print()
        show({f"{number}. {entries.pop('name')}": entries.pop("where"), **entries}, as_json)
