"""A study from beginning to end: what is missing is run, each result is kept at once, all are summed up."""

import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from greenough.instrument.files import atomic_path, make_folder

from ..benchmarks.rows import Row
from .runs import Outcome, Run, execute, keep, kept, nan_as_null
from .study_file import StudyFile
from .summary import Statistics, rows, statistics, tables

Execute = Callable[[Sequence[Run]], Iterable[tuple[Run, Outcome]]]
"""Does runs, in any order, and gives back each as soon as it is done."""


@dataclass(frozen=True)
class Summary:
    """What a study found.

    Parameters
    ----------
    rows : list of Row
        What must hold.
    statistics : list of Statistics
    tables : dict
        For reading.
    failures : list of dict
        Case, seed, repeat and sentence of every failed run.
    versions : list of mapping
        The different sets of packages that the results were computed with.
    """

    rows: list[Row]
    statistics: list[Statistics]
    tables: dict[str, list[dict[str, Any]]]
    failures: list[dict[str, Any]]
    versions: list[Mapping[str, str]]


def here(runs: Sequence[Run]) -> Iterator[tuple[Run, Outcome]]:
    """One run after the other, in this process."""
    for run in runs:
        yield run, execute(run)


def missing(runs: Sequence[Run], folder: Path) -> list[Run]:
    """Those that have no result in ``folder`` yet; of several with the same result, one.

    Raises InputError for a damaged result.
    """
    return list({run.digest: run for run in reversed(runs) if kept(folder, run) is None}.values())[::-1]


def run_study(
    study: StudyFile,
    runs: Sequence[Run],
    folder: Path,
    execute_all: Execute = here,
    advance: Callable[[float], None] = lambda runs: None,
) -> Summary:
    """Do what is missing, keep each result at once, and sum up all of them.

    Results are files of ``folder``, named after all that decides on them: where the study file or a setting has
    changed, runs that it concerns are done again, the others are not, and the old results stay. A failed run is a
    result too. ``summary.json`` is written when all runs are done.

    Parameters
    ----------
    study : StudyFile
    runs : sequence of Run
        All of them, see ``runs_of``.
    folder : Path
        Made if it is not there.
    execute_all : callable
        Where the runs are done.
    advance : callable
        Called with 1 after each run of ``missing``.

    Raises
    ------
    InputError
        If a result in ``folder`` is damaged, or nothing can be written there.
    """
    make_folder(folder)
    for run, outcome in execute_all(missing(runs, folder)):
        keep(folder, run, outcome)
        advance(1)
    finished = [(run, outcome) for run in runs if (outcome := kept(folder, run)) is not None]
    found = statistics(finished)
    summary = Summary(
        rows=rows(study, finished, found),
        statistics=found,
        tables=tables(study, finished, found),
        failures=[
            {"case": run.case, "seed": run.seed, "repeat": run.repeat, "failure": outcome.failure}
            for run, outcome in finished
            if outcome.failure is not None
        ],
        versions=[dict(each) for each in dict.fromkeys(tuple(outcome.versions.items()) for _, outcome in finished)],
    )
    files = [
        {"case": run.case, "seed": run.seed, "repeat": run.repeat, "file": run.file_name, "seconds": outcome.seconds}
        for run, outcome in finished
    ]
    document = {"study": study.model_dump(mode="json"), "runs": files} | asdict(summary)
    with atomic_path(folder / "summary.json") as temporary:
        temporary.write_text(json.dumps(nan_as_null(document), indent=1, allow_nan=False), encoding="utf-8")
    return summary
