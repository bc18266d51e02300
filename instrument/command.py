"""The ``greenough`` command: a root that collects its verbs from the installed packages."""

import os
import signal
import sys
import traceback
from collections.abc import Iterable, Sequence
from importlib.metadata import EntryPoint, entry_points
from types import FrameType
from typing import Annotated, NoReturn

import typer

from .backend import VARIABLE, VARIANTS
from .errors import InputError

GROUP = "greenough.commands"
INTERRUPTED = 130


def main() -> NoReturn:
    """Run the command line of this process and exit: 0 done, 1 a row not as expected, 2 bad input, 130 interrupted."""
    signal.signal(signal.SIGTERM, _terminate)
    sys.exit(run(sys.argv[1:], entry_points(group=GROUP)))


def run(arguments: Sequence[str], sources: Iterable[EntryPoint]) -> int:
    """Run one command line with the verbs of ``sources`` and return its exit code.

    A verb ends with ``typer.Exit(1)`` when a row is not as expected, and raises InputError for bad input. Any other
    exception is a programming error and passes through.
    """
    try:
        typer.main.get_command(collect(sources))(list(arguments), prog_name="greenough")
    except InputError as error:
        print(f"greenough: {error}", file=sys.stderr)
        return 2
    except SystemExit as ending:
        if ending.code != INTERRUPTED:
            return ending.code if isinstance(ending.code, int) else int(ending.code is not None)
    except KeyboardInterrupt:  # while the verbs were being collected; later ones typer turns into an exit
        pass
    else:
        return 0
    print("greenough: interrupted; nothing half-written is left.", file=sys.stderr)
    return INTERRUPTED


def collect(sources: Iterable[EntryPoint]) -> typer.Typer:
    """A root app with the commands of every source at its top level.

    A package that is not installed brings nothing. One that is installed and fails to import costs its own verbs
    alone: what went wrong is printed to standard error.
    """
    # Plain help: Rich alone takes as long to load as everything else together.
    root = typer.Typer(
        no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None
    )

    @root.callback()
    def greenough(
        variant: Annotated[
            str | None,
            typer.Option(
                "--variant",
                metavar="|".join(VARIANTS),
                help=f"Where to render and decode, as ${VARIABLE}. [default: on a GPU where there is one]",
            ),
        ] = None,
    ) -> None:
        """Calibrate a fringe-projection profilometer, measure with it, and compare with what should be there."""
        if variant is not None:
            if variant not in VARIANTS:
                raise InputError(f"--variant {variant!r} cannot render fringe stacks: use one of {', '.join(VARIANTS)}")
            os.environ[VARIABLE] = variant  # verbs import what computes only after this

    for source in sorted(sources, key=lambda source: source.name):
        try:
            root.add_typer(source.load())
        except Exception as error:
            if not _is_absent(source.module, error):
                frames = [
                    frame for frame in traceback.extract_tb(error.__traceback__) if "<frozen" not in frame.filename
                ]
                print(
                    f"greenough: the verbs of {source.value} are missing: {type(error).__name__}: {error} "
                    f"({frames[-1].filename}:{frames[-1].lineno})",
                    file=sys.stderr,
                )
    return root


def _is_absent(module: str, error: Exception) -> bool:
    """Whether loading failed because a package above ``module`` does not exist."""
    return isinstance(error, ModuleNotFoundError) and error.name is not None and module.startswith(f"{error.name}.")


def _terminate(signal_number: int, frame: FrameType | None) -> NoReturn:
    """End by an exception, so that open files are removed on the way out."""
    raise SystemExit(128 + signal_number)
