"""The verb ``decode``: frames from anybody's files to a phase map in one file."""

from collections.abc import Sequence
from itertools import accumulate
from math import pi
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, TypeVar

import typer

from greenough.instrument.errors import InputError
from greenough.instrument.verbs import JsonOption, output_file, show

from .fringes import PAPER, FringeSet

if TYPE_CHECKING:
    from greenough.instrument.frame_files import FrameFiles

    from .order_search import ColumnWindow

app = typer.Typer()

_Number = TypeVar("_Number", int, float)

KIND = "greenough phase map"
VERSION = 1

_UNITS = {"absolute": "rad", "modulation": "DN", "background": "DN", "valid": "1", "residual": "rad", "sigma": "rad"}


def _listed(values: Sequence[float]) -> str:
    return ",".join(f"{value:g}" for value in values)


@app.command()
def decode(
    frames: Annotated[
        list[str],
        typer.Argument(
            metavar="FRAMES...",
            help="Images, folders, globs or TIFF files of several pages, in the order of the patterns or with names "
            "that tell it; or one .npy, .npz or .h5 file with the whole stack (FILE.h5:DATASET where there are "
            "several).",
        ),
    ],
    out: Annotated[
        Path, typer.Option("--out", metavar="FILE.h5", help="The phase map to write.", callback=output_file)
    ],
    periods: Annotated[
        str, typer.Option("--periods", help="Fringe periods, projector columns, in the order of the frames.")
    ] = _listed(PAPER.periods),
    steps: Annotated[str, typer.Option("--steps", help="Phase steps of each period.")] = _listed(PAPER.steps),
    direction: Annotated[
        Literal["vertical", "horizontal"],
        typer.Option("--direction", help="Of the fringes; horizontal ones count rows wherever columns are spoken of."),
    ] = "vertical",
    field: Annotated[
        float | None,
        typer.Option("--field", help="Lit columns, where no period spans them. [default: the coarsest period]"),
    ] = None,
    sign: Annotated[int, typer.Option("--sign", help="1 if a step adds to the phase, -1 if it takes from it.")] = 1,
    start_deg: Annotated[float, typer.Option("--start-deg", help="Phase of each first frame on column 0.")] = 0.0,
    fringe_frames: Annotated[
        str | None, typer.Option("--fringe-frames", help="Which frames show fringes, from 0: 3-5,0-2. [default: all]")
    ] = None,
    gray_frames: Annotated[
        str | None, typer.Option("--gray-frames", help="Which frames show a Gray code, its coarsest bit first.")
    ] = None,
    gray_inverse: Annotated[
        bool, typer.Option("--gray-inverse", help="Each frame of the Gray code is followed by its inverse.")
    ] = False,
    gray_width: Annotated[
        float | None,
        typer.Option("--gray-width", help="Columns of the Gray code's stripes. [default: the finest period]"),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Decode phase-shifted frames to phase, modulation, background.

    The n-th of the N frames of a period p is A + B cos(2π x / p + start + sign 2π n / N).
    """
    import numpy as np

    from greenough.instrument import hdf5
    from greenough.instrument.frame_files import read_frames

    from .decode import decode as decode_stack

    if gray_frames is not None and field is None:
        raise InputError("--gray-frames: give --field as well, the number of lit columns")
    fringes = fringe_set(periods, steps, field, sign, start_deg)
    if out.suffix != ".h5":
        raise InputError(f"phase map {out}: the name must end in .h5")
    files = read_frames(frames)
    order, reason = frames_in_order(files, periods, steps, fringe_frames, gray_frames)
    window = _gray(files, order, gray_frames, gray_inverse, gray_width or fringes.periods[-1])
    phase_map = decode_stack(files.stack[order], fringes, window=window)
    with hdf5.create(out, KIND, VERSION) as file:
        file.attrs["periods_px"] = fringes.periods
        file.attrs["steps"] = fringes.steps
        file.attrs["direction"] = np.bytes_(direction)
        file.attrs["start_rad"], file.attrs["sign"] = fringes.start, fringes.sign
        for name, units in _UNITS.items():
            hdf5.put(file, name, getattr(phase_map, name), units)
    valid = phase_map.valid
    show(
        {
            "out": out,
            "order": reason,
            "frames": [files.names[k] for k in order],
            "direction": direction,
            "shape": valid.shape,
            "valid_share": valid.mean(),
            "median_modulation_dn": np.median(phase_map.modulation[valid]) if valid.any() else None,
            "median_sigma_rad": np.median(phase_map.sigma[valid]) if valid.any() else None,
        },
        as_json,
    )


def fringe_set(periods: str, steps: str, field: float | None, sign: int, start_deg: float) -> FringeSet:
    """The fringes of these options, the coarsest first.

    Raises
    ------
    InputError
        If they are no numbers, or not as many of one as of the other, or cannot be decoded.
    """
    given, given_steps = _numbers(periods, "--periods", float), _numbers(steps, "--steps", int)
    if len(given) != len(given_steps):
        raise InputError(f"--periods {periods} and --steps {steps}: give one number of steps for each period")
    coarsest_first = _coarsest_first(given)
    return FringeSet(
        tuple(given[k] for k in coarsest_first),
        tuple(given_steps[k] for k in coarsest_first),
        field=field,
        start=start_deg * pi / 180,
        sign=sign,
    )


def frames_in_order(
    files: "FrameFiles", periods: str, steps: str, fringe_frames: str | None, gray_frames: str | None = None
) -> tuple[list[int], str]:
    """Numbers of the frames that show fringes, in the order of `fringe_set`, and why these.

    Raises
    ------
    InputError
        If they are not as many as the steps.
    """
    given, given_steps = _numbers(periods, "--periods", float), _numbers(steps, "--steps", int)
    order, reason = _order(files, given, given_steps, fringe_frames, gray_frames)
    ends = list(accumulate(given_steps))
    return [order[n] for k in _coarsest_first(given) for n in range(ends[k] - given_steps[k], ends[k])], reason


def _coarsest_first(periods: Sequence[float]) -> list[int]:
    return sorted(range(len(periods)), key=lambda k: -periods[k])


def _order(
    files: "FrameFiles",
    periods: Sequence[float],
    steps: Sequence[int],
    fringe_frames: str | None,
    gray_frames: str | None,
) -> tuple[list[int], str]:
    """Numbers of the frames that show fringes, in the order of ``periods``, and why these."""
    from greenough.instrument.frame_order import guess_order, selected

    count = len(files.stack)
    if fringe_frames is not None:
        order, reason = selected(fringe_frames, count, "--fringe-frames"), "--fringe-frames"
    else:
        gray = selected(gray_frames, count, "--gray-frames") if gray_frames else []
        rest = [k for k in range(count) if k not in gray]
        if len(rest) == sum(steps):
            order, reason = guess_order([files.names[k] for k in rest], periods, steps)
            return [rest[k] for k in order], reason
        order, reason = rest, "the order of the files"
    if len(order) != sum(steps):
        raise InputError(
            f"frame stack: it holds {len(order)} frames but the fringe set with steps {tuple(steps)} needs {sum(steps)}"
        )
    return order, reason


def _gray(
    files: "FrameFiles", fringe_frames: Sequence[int], gray_frames: str | None, inverse: bool, stripe_width: float
) -> "ColumnWindow | None":
    """Where the Gray code says that pixels are; without inverse frames, grey between black and white is the fringes'
    mean."""
    from greenough.instrument.frame_order import selected

    from .gray_code import locate

    if gray_frames is None:
        return None
    frames = selected(gray_frames, len(files.stack), "--gray-frames")
    if inverse and len(frames) % 2:
        raise InputError(f"--gray-frames {gray_frames}: with --gray-inverse they must be even in number")
    if inverse:
        return locate(files.stack[frames[::2]], files.stack[frames[1::2]], stripe_width)
    mean = files.stack[list(fringe_frames)].mean(axis=0, keepdims=True, dtype="float32")
    return locate(files.stack[frames], mean, stripe_width)


def _numbers(text: str, option: str, kind: type[_Number]) -> tuple[_Number, ...]:
    try:
        return tuple(kind(item) for item in text.split(","))
    except ValueError:
        whole = "whole " if kind is int else ""
        raise InputError(
            f"{option} {text}: must be {whole}numbers separated by commas, as in {_listed((8, 4))}"
        ) from None
