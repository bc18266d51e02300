"""The verbs of the instrument: check, live, record, replay."""

import sys
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from .verbs import JsonOption, RigArgument, RunOption, SetOption, output_file, show

if TYPE_CHECKING:
    from collections.abc import Callable

    import numpy as np

    from .image_rig import ImageRig

app = typer.Typer()


@app.command()
def check(
    rig: RigArgument,
    move: Annotated[
        bool, typer.Option("--move", help="Home the stage if need be, and drive it to both ends and back.")
    ] = False,
    as_it_lies: Annotated[
        bool, typer.Option("--as-it-lies", help="Look at what lies there instead of the white side of the board.")
    ] = False,
    settings: SetOption = None,
    as_json: JsonOption = False,
) -> None:
    """Connect to a rig, and say what is wrong and what to do.

    It reports what answers, takes a few frames and judges them, a row for each check. The projector is lit meanwhile;
    nothing moves without --move. Of images it says what they hold, a row for each posture and plane, and what is wrong
    with them. A recording is only described. The exit code is 1 if a row does not hold.
    """
    from .errors import InputError
    from .image_rig import ImageRig
    from .opening import open_rig
    from .progress import progress
    from .rig_check import check_rig, describe_as_it_stands

    with open_rig(rig, settings or ()) as opened:
        description = describe_as_it_stands(opened)
        result = {**description.pop("identity"), **description}
        devices, checks = opened.devices, ()
        if devices:
            checks = check_rig(opened, move, as_it_lies)
            result |= {"devices": [asdict(device) for device in devices], "checks": [asdict(row) for row in checks]}
        elif move or as_it_lies:
            raise InputError(f"nothing of {rig} can be moved or lit: leave --move and --as-it-lies out")
        elif isinstance(opened, ImageRig):
            with progress(len(opened.places), "looking at images", quiet=as_json) as advance:
                checks = tuple(row for look in _image_checks() for row in look(opened, advance))
            result |= {"checks": [asdict(row) for row in checks]}
    show(result, as_json)
    if any(row.holds is False for row in checks):
        raise typer.Exit(1)


@app.command()
def live(
    rig: RigArgument,
    sample: Annotated[
        str | None, typer.Option("--sample", metavar="NAME|MESHFILE", help="Part to place. [default: what lies there]")
    ] = None,
    exposure_us: Annotated[float | None, typer.Option(help="Exposure time. [default: the camera's]")] = None,
    port: Annotated[int, typer.Option(help="Where the page is served on 127.0.0.1; 0 is any free port.")] = 8765,
    rounds: Annotated[
        int | None, typer.Option(min=1, help="End after so many rounds of five frames. [default: go on]")
    ] = None,
    settings: SetOption = None,
) -> None:
    """Show what the camera sees in a browser, for alignment.

    The page has image, saturation, fringe modulation and focus, and is served to this machine alone. Ctrl-C ends it.
    """
    from . import live
    from .contract import Placement
    from .errors import InputError
    from .opening import open_rig
    from .signals import until_told_to_end

    rig_to_open, view = open_rig(rig, settings or ()), live.View()
    with live.serving(view, port) as address:
        print(f"greenough: {address} shows what the camera sees; Ctrl-C ends it", file=sys.stderr)
        try:
            with rig_to_open as opened, until_told_to_end():
                if exposure_us is not None:
                    opened.camera.exposure_us = exposure_us
                if sample is not None:
                    opened.operator.place(Placement(sample))
                live.watch(opened, view, rounds)
        except InputError as error:  # the light is off by now
            view.fail(str(error))
            raise


@app.command()
def record(
    rig: RigArgument,
    out: Annotated[
        Path,
        typer.Option("--out", metavar="FILE.h5", help="Where to write the recording.", callback=output_file),
    ],
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


def _image_checks() -> "list[Callable[[ImageRig, Callable[[float], None]], list[Any]]]":
    """What tells what images hold: of packages that know fringes and boards, found as the verbs are."""
    from importlib.metadata import entry_points

    return [entry.load() for entry in entry_points(group="greenough.image_checks")]


def _load_patterns(path: Path) -> "np.ndarray":
    import numpy as np

    from .errors import InputError
    from .file_errors import reading
    from .files import check_readable

    unusable = f"patterns {path} cannot be read; give a NumPy file (.npy) of uint8 (N, rows, cols)"
    check_readable(path, missing=unusable)
    with reading(path):
        try:
            patterns = np.load(path, allow_pickle=False)
        except (ValueError, EOFError):
            patterns = None
    if not isinstance(patterns, np.ndarray):
        raise InputError(unusable)
    return patterns
