"""The verb ``report``."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from greenough.instrument.progress import progress
from greenough.instrument.verbs import JsonOption, output_file, output_folder, show

app = typer.Typer()

ReportOption = Annotated[
    Path | None,
    typer.Option(
        "--report", metavar="FILE.html", help="Write a page that shows the result as well.", callback=output_file
    ),
]


@app.command()
def report(
    result: Annotated[
        Path,
        typer.Argument(metavar="RESULT", help="A cloud (.ply), a calibration (.h5), a table (.json), a demo's folder."),
    ],
    mesh: Annotated[
        Path | None, typer.Argument(metavar="[MESH]", help="What a cloud should lie on: PLY, STL or OBJ, in mm.")
    ] = None,
    align: Annotated[
        Literal["none", "rigid", "similarity"],
        typer.Option("--align", help="Motion of the points before comparing, as of `greenough compare`."),
    ] = "none",
    out: Annotated[
        Path, typer.Option("--out", metavar="FILE.html", help="The page to write.", callback=output_file)
    ] = Path("report.html"),
    png: Annotated[
        Path | None,
        typer.Option(
            "--png", metavar="FOLDER", help="Where the figures go as PNG too, for papers.", callback=output_folder
        ),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Make a page of a result: tables, figures, and surfaces to turn.

    It is one file that opens without a network.
    """
    from .report.page import write_page
    from .report.results import page_of

    with progress(1, f"reporting on {result}", quiet=as_json) as advance:
        page = page_of(result, mesh, for_papers=png is not None, align=align)
        write_page(out, page, png)
        advance(1)
    shown = {"report": out, "bytes": out.stat().st_size, "surfaces": len(page.surfaces)}
    show(shown if png is None else {**shown, "figures": png}, as_json)
