"""The verbs that need a twin: demo, study and bench."""

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from greenough.instrument.files import check_folder
from greenough.instrument.progress import progress
from greenough.instrument.verbs import JsonOption, SetOption, output_file, output_folder, show
from greenough.pipeline.report_command import ReportOption

from .benchmarks.required import REQUIRED, Section

app = typer.Typer()

_COLUMNS = (
    "claim", "specimen", "calibration", "paper", "measured", "unit", "n", "limit", "predicted", "predicted_sd", "holds",
    "expected_to_hold",
)  # fmt: skip


@app.command()
def demo(
    rig: Annotated[str, typer.Argument(metavar="[RIG]", help="A twin.")] = "twin",
    out: Annotated[
        Path, typer.Option("--out", metavar="FOLDER", help="Where the files go.", callback=output_folder)
    ] = Path("build/demo"),
    settings: SetOption = None,
    as_json: JsonOption = False,
) -> None:
    """Calibrate a twin, measure, and judge the paper's claims.

    Prints the verdict on them; all rows are in claims.json, and report.html shows them. Exits with 1 if a row behaves
    otherwise than expected. Where its limit lies within the spread of what is predicted, nothing is expected.
    """
    from .demo import demonstrate, steps
    from .verdict import screen_lines, verdict_of

    overrides = settings or []
    with progress(steps(rig, overrides), "demo", quiet=as_json) as advance:
        claims = demonstrate(rig, overrides, out, advance)
    verdict = verdict_of(claims)
    unexpected = [claim.claim for claim in claims if not claim.as_expected]
    if not as_json:
        print("\n".join(screen_lines(verdict, out)))
    else:
        rows = [{name: getattr(claim, name) for name in _COLUMNS} for claim in claims]
        show({"verdict": verdict.plain, "claims": rows, "unexpected": unexpected, "folder": out}, as_json)
    if unexpected:
        raise typer.Exit(1)


@app.command()
def study(
    study: Annotated[str, typer.Argument(metavar="STUDY", help="A built-in study, or a study file.")],
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", metavar="FOLDER", help="Where results go. [default: build/studies/STUDY]", callback=output_folder
        ),
    ] = None,
    scheduler: Annotated[
        str | None, typer.Option("--scheduler", metavar="ADDRESS", help="Run on the workers of a Dask scheduler.")
    ] = None,
    settings: SetOption = None,
    as_json: JsonOption = False,
) -> None:
    """Take many instruments through an experiment, case by case.

    Draws the instruments and sums up what comes of it. Goes on from FOLDER where it was interrupted. Exits with 1 if
    a run failed or a limit of the study does not hold.
    """
    from .studies.cluster import on_cluster
    from .studies.runs import runs_of
    from .studies.study import here, missing, run_study
    from .studies.study_file import load_study
    from .studies.verdict import screen_lines, sentence

    chosen = load_study(study)
    runs = runs_of(chosen, settings or [])
    folder = out or Path("build/studies") / Path(study).stem
    check_folder(folder)
    execute_all = on_cluster(scheduler) if scheduler else here
    with progress(len(missing(runs, folder)), chosen.name, quiet=as_json) as advance:
        summary = run_study(chosen, runs, folder, execute_all, advance)
    if as_json:
        figures = {"statistics": [asdict(each) for each in summary.statistics]}
        rows = {"rows": [asdict(row) for row in summary.rows]}
        rows |= {"failures": summary.failures, "versions": summary.versions, "folder": folder}
        show({"verdict": sentence(summary, len(runs))} | figures | summary.tables | rows, as_json)
    else:
        print("\n".join(screen_lines(summary, len(runs), folder)))
    if any(row.holds is False for row in summary.rows):
        raise typer.Exit(1)


@app.command()
def accept(
    rig: Annotated[str, typer.Argument(metavar="RIG", help="A twin.")],
    calibration: Annotated[
        Path | None,
        typer.Option("--calibration", metavar="CAL.h5", help="Of this rig. [default: calibrated first, beside FILE]"),
    ] = None,
    out: Annotated[
        Path, typer.Option("--out", metavar="FILE.json", help="Where the table goes.", callback=output_file)
    ] = Path("acceptance.json"),
    report: ReportOption = None,
    settings: SetOption = None,
    as_json: JsonOption = False,
) -> None:
    """Measure certified artefacts with a twin and judge the results.

    Spheres, planes, steps, grating, noise, resolution and parts. Exits with 1 if a row does not keep to its limit or
    is missing.
    """
    from .acceptance.table import accept as run
    from .acceptance.table import captures, verdict_lines
    from .acceptance.verdict import plain, screen_lines

    overrides = settings or []
    total = captures(rig, overrides, calibrated=calibration is not None)
    with progress(total, "accepting", quiet=as_json) as advance:
        table = run(rig, overrides, calibration, out, advance)
    if report is not None:
        from greenough.pipeline.report.page import write_page
        from greenough.pipeline.report.results import table_page

        write_page(report, table_page(out))
    lines = verdict_lines(table)
    if as_json:
        rows = [asdict(row) for row in table.rows]
        beside = {"not_holding": table.not_holding, "missing": dict(table.missing), "table": out}
        show({"verdict": plain(lines), "rows": rows, **beside}, as_json)
    else:
        print("\n".join(screen_lines(table, lines, out)))
    if not table.holds:
        raise typer.Exit(1)


@app.command()
def bench(
    rig: Annotated[str, typer.Argument(metavar="[RIG]", help="A twin.")] = "twin",
    only: Annotated[Section | None, typer.Option("--only", help="One section of the table. [default: all]")] = None,
    settings: SetOption = None,
    as_json: JsonOption = False,
) -> None:
    """Time the costly steps beside what others need for the same.

    Exits with 1 if a row is missing or does not keep to its limit.
    """
    from .benchmarks.environment import environment
    from .benchmarks.table import bench as run

    sections: list[Section] = [only] if only else list(REQUIRED)
    with progress(len(sections), "bench", quiet=as_json) as advance:
        table = run(rig, settings or [], sections, advance)
    beside = {"not_holding": table.not_holding, "missing": dict(table.missing), "environment": environment()}
    show({"rows": [asdict(row) for row in table.rows], **beside}, as_json)
    if not table.holds:
        raise typer.Exit(1)
