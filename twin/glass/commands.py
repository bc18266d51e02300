"""The verb that shows the lenses: optics."""

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from greenough.instrument.progress import progress
from greenough.instrument.verbs import JsonOption, SetOption, output_folder, show

app = typer.Typer()


@app.command()
def optics(
    rig: Annotated[str, typer.Argument(metavar="[RIG]", help="A twin.")] = "twin",
    out: Annotated[
        Path, typer.Option("--out", metavar="FOLDER", help="Where the pictures go.", callback=output_folder)
    ] = Path("build/optics"),
    settings: SetOption = None,
    as_json: JsonOption = False,
) -> None:
    """Draw both lens paths with rays, their spots and aberrations.

    Prints what they amount to to first order.
    """
    from greenough.instrument.files import make_folder
    from greenough.instrument.rigfile import load_rig_file

    from ..settings import twin_settings
    from .figure import draw_path
    from .paraxial import paraxial
    from .placed import place
    from .prescription import BUILT_IN, load_prescription

    twin_settings(load_rig_file(rig, settings or []))  # refuses what is no twin
    make_folder(out)
    summaries, files = {}, []
    with progress(len(BUILT_IN), "drawing", quiet=as_json) as advance:
        for name in BUILT_IN:
            prescription = load_prescription(name)
            summaries[name] = asdict(paraxial(prescription))
            files += draw_path(place(prescription), out)
            advance(1)
    if as_json:
        show({**summaries, "files": files}, as_json)
    else:
        show({"first order": _table(summaries), "files": files}, as_json)


def _table(summaries: dict[str, dict[str, object]]) -> list[dict[str, object]]:
    """One row for each quantity, one column for each path."""
    flat = {}
    for path, summary in summaries.items():
        flat[path] = {}
        for name, value in summary.items():
            parts = value.items() if isinstance(value, dict) else [(None, value)]
            flat[path] |= {name if part is None else f"{name} pupil {part}": item for part, item in parts}
    first, second = flat
    return [{"quantity": name, first: flat[first][name], second: flat[second][name]} for name in flat[first]]
