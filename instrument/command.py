"""The ``greenough`` command: a root that collects its verbs from the installed packages."""

import errno
import os
import signal
import sys
import traceback
from collections.abc import Iterable, Sequence
from contextlib import suppress
from importlib.metadata import EntryPoint, entry_points
from types import FrameType
from typing import Annotated, Any, NoReturn, TextIO, cast

import typer

from .backend import VARIABLE, VARIANTS
from .errors import InputError
from .file_errors import cannot_use

GROUP = "greenough.commands"
INTERRUPTED = 128 + signal.SIGINT
UNREAD = 128 + signal.SIGPIPE


def main() -> NoReturn:
    """Run the command line of this process and exit with its code.

    0 is done, 1 a row not as expected, 2 bad input or a file that cannot be written, 130 interrupted, 141 unread.
    """
    signal.signal(signal.SIGTERM, _terminate)
    sys.exit(run(sys.argv[1:], entry_points(group=GROUP)))


def run(arguments: Sequence[str], sources: Iterable[EntryPoint]) -> int:
    """Run one command line with the verbs of ``sources`` and return its exit code.

    A verb ends with ``typer.Exit(1)`` when a row is not as expected, and raises InputError for bad input. What the
    operating system refuses to do with a file becomes a sentence as well, wherever it was met, and so does what it
    refuses to do with standard output. If nobody reads that any more, as behind ``head``, nothing is said, and the code
    is that of SIGPIPE. Any other exception is a programming error and passes through.
    """
    output = sys.stdout
    watched = _Watched(output)
    if output is not None:
        sys.stdout = cast(TextIO, watched)
    try:
        code = _exit_code(arguments, sources)
        refusal = watched.refusal or _refusal_of(output)
    except InputError as error:
        return _tell(str(error), 2)
    except KeyboardInterrupt:
        return _tell("interrupted; nothing half-written is left.", INTERRUPTED)
    except OSError as error:
        refusal = watched.refusal or _refusal_of(output)
        if refusal is None:
            sentence = cannot_use(error)
            if sentence is None:
                raise
            return _tell(str(sentence), 2)
    finally:
        sys.stdout = cast(TextIO, output)
    if refusal is None or output is None:
        return code
    _silence(output)
    if refusal.errno == errno.EPIPE:
        return UNREAD
    cause = os.strerror(refusal.errno or 0).lower()
    return _tell(f"cannot write to standard output: {cause}; remove the cause, or send it elsewhere", 2)


class _Watched:
    """A stream that remembers why it could not be written to.

    Where standard output has no buffer, as with PYTHONUNBUFFERED, the error comes while a verb prints, and does not say
    of itself that it is about standard output.
    """

    def __init__(self, stream: TextIO | None):
        self._stream = stream
        self.refusal: OSError | None = None

    def write(self, text: str) -> int:
        return self._watch("write", text)

    def flush(self) -> None:
        self._watch("flush")

    def _watch(self, name: str, *arguments: str) -> Any:
        try:
            return getattr(self._stream, name)(*arguments)
        except OSError as error:
            self.refusal = error
            raise

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


def _exit_code(arguments: Sequence[str], sources: Iterable[EntryPoint]) -> int:
    """Of a command line that was not refused; raises KeyboardInterrupt where it was interrupted."""
    output = sys.stdout
    try:
        typer.main.get_command(collect(sources))(list(arguments), prog_name="greenough")
    except SystemExit as ending:
        if sys.stdout is not output:  # typer's answer to a pipe that nobody reads any more
            sys.stdout = output
            if isinstance(ending.__context__, OSError):
                raise ending.__context__ from None
        if ending.code == INTERRUPTED:
            raise KeyboardInterrupt from None
        return ending.code if isinstance(ending.code, int) else int(ending.code is not None)
    return 0


def _refusal_of(output: TextIO | None) -> OSError | None:
    """Why what was printed cannot be written; None where it was, and where nothing is printed to."""
    if output is None or output.closed:
        return None
    try:
        output.flush()
    except OSError as error:
        return error
    return None


def _silence(output: TextIO) -> None:
    """Send what could not be written nowhere: else the interpreter tries again, and complains, at its end."""
    with suppress(OSError):  # of a stream in memory
        nowhere = os.open(os.devnull, os.O_WRONLY)
        try:
            os.dup2(nowhere, output.fileno())
        finally:
            os.close(nowhere)


def _tell(sentence: str, code: int) -> int:
    """Print one line on standard error, if anybody listens."""
    with suppress(OSError):
        print(f"greenough: {sentence}", file=sys.stderr, flush=True)
    return code


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
