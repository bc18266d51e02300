"""Progress of long work, for a person at a terminal."""

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager


@contextmanager
def progress(total: float, description: str, quiet: bool = False) -> Iterator[Callable[[float], None]]:
    """Show a bar with the estimated time left on standard error.

    Silent when ``quiet`` or when standard error is not a terminal.

    Yields
    ------
    callable
        Call it with how much of ``total`` has been done since the last call.
    """
    if quiet or not sys.stderr.isatty():
        yield lambda amount: None
        return

    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    # The estimate is from the speed over so many seconds: steps may take minutes each.
    with Progress(*columns, console=Console(stderr=True), transient=True, speed_estimate_period=3600) as bar:
        task = bar.add_task(description, total=total)
        yield lambda amount: bar.advance(task, amount)
