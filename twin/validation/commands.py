"""The verbs that need a twin: demo, budget and bench."""

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from greenough.instrument.progress import progress
from greenough.instrument.verbs import JsonOption, SetOption, show

app = typer.Typer()


@app.command()
def demo(
    rig: Annotated[str, typer.Argument(metavar="[RIG]", help="A twin.")] = "twin",
    out: Annotated[Path, typer.Option("--out", metavar="FOLDER", help="Where the files go.")] = Path("build/demo"),
    settings: SetOption = None,
    as_json: JsonOption = False,
) -> None:
    """Calibrate a twin, measure the paper's specimens, and print its claims beside what was measured.

    Exits with 1 if a row behaves otherwise than expected. Where its limit lies within the spread of what is predicted,
    nothing is expected.
    """
    from .demo import demonstrate, steps

    overrides = settings or []
    with progress(steps(rig, overrides), "demo", quiet=as_json) as advance:
        claims = demonstrate(rig, overrides, out, advance)
    columns = ("claim", "specimen", "calibration", "paper", "measured", "unit", "n", "limit", "predicted")
    columns += ("predicted_sd", "holds", "expected_to_hold")
    table = [{name: row[name] for name in columns} for row in map(asdict, claims)]
    unexpected = [claim.claim for claim in claims if not claim.as_expected]
    show({"claims": table, "unexpected": unexpected, "folder": out}, as_json)
    if unexpected:
        raise typer.Exit(1)


@app.command()
def budget(
    rig: Annotated[str, typer.Argument(metavar="[RIG]", help="A twin.")] = "twin",
    out: Annotated[Path, typer.Option("--out", metavar="FILE", help="Where the lines go.")] = Path("budget.json"),
    settings: SetOption = None,
    as_json: JsonOption = False,
) -> None:
    """Calibrate and measure planes with each physical effect off, and with each alone; say what it costs.

    Each line takes a calibration and ten captures; goes on from FILE where it was interrupted.
    """
    from .budget import budget as run
    from .budget import steps_to_do, tables

    overrides = settings or []
    with progress(steps_to_do(rig, overrides, out), "budget", quiet=as_json) as advance:
        costs = run(rig, overrides, out, advance)
    show(tables(costs), as_json)


@app.command()
def bench(
    rig: Annotated[str, typer.Argument(metavar="[RIG]", help="A twin.")] = "twin",
    settings: SetOption = None,
    as_json: JsonOption = False,
) -> None:
    """Time the costly steps on this machine.

    Exits with 1 if a ratio exceeds its limit.
    """
    from .benchmark import benchmark

    with progress(5, "bench", quiet=as_json) as advance:
        rows = benchmark(rig, settings or [], advance)
    show({"rows": [asdict(row) for row in rows]}, as_json)
    if any(row.holds is False for row in rows):
        raise typer.Exit(1)
