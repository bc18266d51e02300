"""What the verbs of all packages share: the options they have in common, and how a result is shown."""

import json
import math
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from .files import check_file, check_folder

RigArgument = Annotated[str, typer.Argument(metavar="RIG", help="A built-in rig, a rig file, or a recording (.h5).")]
SetOption = Annotated[
    list[str] | None, typer.Option("--set", metavar="SECTION.FIELD=VALUE", help="Replace a setting of the rig file.")
]
RunOption = Annotated[str, typer.Option("--run", metavar="NAME", help="Name of the run; its noise is its own.")]
JsonOption = Annotated[bool, typer.Option("--json", help="Print the result as JSON and show no progress.")]


def output_file(path: Path | None) -> Path | None:
    """The callback of every option that names a file to write: refuses one that cannot be, before any work."""
    if path is not None:
        check_file(path)
    return path


def output_folder(path: Path | None) -> Path | None:
    """The same of an option that names a folder, which is made if it is not there."""
    if path is not None:
        check_folder(path)
    return path


def show(result: Mapping[str, Any], as_json: bool) -> None:
    """Print a verb's result on standard output.

    Parameters
    ----------
    result : mapping
        Names with units to values: numbers, text, arrays, mappings of these, or lists of mappings, which are printed
        as tables.
    as_json : bool
        Print JSON, in which a number that is not finite becomes null.
    """
    plain = _plain(result)
    if as_json:
        json.dump(plain, sys.stdout, indent=2, allow_nan=False, ensure_ascii=False)
        print()
        return
    width = max((len(name) for name in plain), default=0)
    for name, value in plain.items():
        if isinstance(value, list) and value and all(isinstance(row, dict) for row in value):
            print(f"{name}:")
            _print_table(value)
        else:
            print(f"{name:{width}}  {_text(value)}")


def _plain(value: Any) -> Any:
    """Only what JSON knows."""
    if isinstance(value, Mapping):
        return {str(name): _plain(item) for name, item in value.items()}
    if hasattr(value, "tolist"):  # NumPy's scalars and arrays
        value = value.tolist()
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if value is None or isinstance(value, bool | int | str):
        return value
    return str(value)


def _print_table(rows: Sequence[Mapping[str, Any]]) -> None:
    names = list(dict.fromkeys(name for row in rows for name in row))
    cells = [names, *([_text(row.get(name)) for name in names] for row in rows)]
    widths = [max(len(row[column]) for row in cells) for column in range(len(names))]
    for row in cells:
        print("  " + "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip())


def _text(value: Any) -> str:
    if value is None:
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, list):
        return ", ".join(_text(item) for item in value) or "-"
    if isinstance(value, dict):
        return ", ".join(f"{name} {_text(item)}" for name, item in value.items()) or "-"
    return str(value)
