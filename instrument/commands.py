"""The verbs of the instrument: check, record, replay."""

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from .verbs import JsonOption, RigArgument, RunOption, SetOption, show

if TYPE_CHECKING:
    import numpy as np

app = typer.Typer()


@app.command()
def check(rig: RigArgument, settings: SetOption = None, as_json: JsonOption = False) -> None:
    """Connect to a rig and report what answers and its limits.

    Nothing moves, and nothing is lit.
    """
    from .journal import describe
    from .opening import open_rig

    with open_rig(rig, settings or ()) as opened:
        description = asdict(describe(opened))
    show({**description.pop("identity"), **description}, as_json)


@app.command()
def record(
    rig: RigArgument,
    out: Annotated[Path, typer.Option("--out", metavar="FILE.h5", help="Where to write the recording.")],
    patterns: Annotated[Path, typer.Option(metavar="FILE.npy", help="Patterns to project, uint8 (N, rows, cols).")],
    samples: Annotated[list[str], typer.Option("--sample", metavar="NAME|MESHFILE", help="Part to place; repeatable.")],
    heights: Annotated[
        list[float] | None, typer.Option("--z-mm", help="Stage position to capture at; repeatable. [default: as it is]")
    ] = None,
    exposure_us: Annotated[float | None, typer.Option(help="Exposure time. [default: the camera's]")] = None,
    run: RunOption = "record",
    settings: SetOption = None,
    as_json: JsonOption = False,
) -> None:
    """Capture patterns on samples and keep all of it in a recording.

    Every sample is captured at every height.
    """
    from . import recording
    from .contract import Placement
    from .opening import open_rig
    from .progress import progress

    stack = _load_patterns(patterns)
    total = len(samples) * len(heights or [0.0])
    with (
        recording.record(open_rig(rig, settings or (), run=run), out) as opened,
        progress(total, "capturing", quiet=as_json) as advance,
    ):
        if exposure_us is not None:
            opened.camera.exposure_us = exposure_us
        for sample in samples:
            opened.operator.place(Placement(sample))
            for height in heights or [None]:
                if height is not None:
                    opened.stage.move_to_mm(height)
                opened.capture(stack)
                advance(1)
    show({"recording": out, "captures": total, "frames": total * len(stack)}, as_json)


@app.command()
def replay(
    recording: Annotated[Path, typer.Argument(metavar="FILE.h5", help="A recording.")], as_json: JsonOption = False
) -> None:
    """Verify every frame of a recording and list what it holds.

    Every other verb takes a recording in place of a rig.
    """
    from .progress import progress
    from .replay import open_recording

    rows = []
    with open_recording(recording) as rig, progress(len(rig.captures), "verifying", quiet=as_json) as advance:
        for index, capture in enumerate(rig.captures):
            frames = rig.frames(index)
            placement = capture.placement
            rows.append(
                {
                    "part": placement and placement.part,
                    "posture": placement and placement.posture,
                    "face": placement and placement.face,
                    "stage_position_mm": frames.stage_position_mm,
                    "exposure_us": frames.exposure_us,
                    "run": frames.run,
                    "first_serial": frames.serials[0],
                    "frames": len(frames.stack),
                    "mean_dn": frames.stack.mean(),
                    "saturated_share": (frames.stack >= frames.full_scale_dn).mean(),
                }
            )
            advance(1)
        show({**asdict(rig.identity), "captures": rows}, as_json)


def _load_patterns(path: Path) -> "np.ndarray":
    import numpy as np

    from .errors import InputError

    try:
        patterns = np.load(path, allow_pickle=False)
    except (OSError, ValueError, EOFError):
        patterns = None
    if not isinstance(patterns, np.ndarray):
        raise InputError(f"patterns {path} cannot be read; give a NumPy file (.npy) of uint8 (N, rows, cols)")
    return patterns
