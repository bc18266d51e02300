"""One run of a study: a case, an instrument and a noise; what comes of it, and the file that keeps it."""

import hashlib
import json
import math
import platform
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

from threadpoolctl import threadpool_limits

from greenough.instrument.errors import FileError, InputError
from greenough.instrument.file_errors import reading
from greenough.instrument.files import atomic_path
from greenough.instrument.rigfile import builtin_rigs, load_rig_file

from ...settings import load_twin_file
from .experiments import Figures, experiment
from .study_file import StudyFile

PACKAGES = ("greenough", "mitsuba", "drjit", "numpy", "scipy", "opencv-python-headless")
"""Whose versions may change a figure."""


@dataclass(frozen=True)
class Run:
    """What is to be done, complete: another machine needs nothing else.

    Parameters
    ----------
    case : str
    seed : int
        Draws the instrument.
    repeat : int
        From 1; each draws noise and drifts of its own.
    kind, rig : str
        The experiment, and the rig's name or absolute path.
    overrides : tuple of str
        All of them, that of the seed included.
    name : str
        The run's name for the twin: cases of one repeat share their noise where both have it.
    settings_sha256 : str
        Digest of the settings that rig and overrides make.
    """

    case: str
    seed: int
    repeat: int
    kind: str
    rig: str
    overrides: tuple[str, ...]
    name: str
    settings_sha256: str

    @property
    def digest(self) -> str:
        """Of all that decides on the result: runs with the same digest have the same result."""
        return hashlib.sha256(json.dumps([self.kind, self.settings_sha256, self.name]).encode()).hexdigest()

    @property
    def file_name(self) -> str:
        """Where the result is kept in the study's folder: a run with other settings has another file."""
        return f"seed-{self.seed}-{self.digest[:16]}.json"


@dataclass(frozen=True)
class Outcome:
    """What came of a run: its lines, or the sentence with which the twin or the pipeline refused this draw."""

    figures: list[Figures]
    failure: str | None
    seconds: float
    versions: Mapping[str, str]


def runs_of(study: StudyFile, overrides: Sequence[str] = ()) -> list[Run]:
    """All runs of a study, instrument by instrument; ``overrides`` come after the study's settings.

    Raises
    ------
    InputError
        If the rig is not a twin, or the settings of a case are refused.
    """
    rig = study.rig if study.rig in builtin_rigs() else str(Path(study.rig).resolve())
    runs = []
    for seed in sorted({*study.seeds, *(seed for seeds in study.instruments.values() for seed in seeds)}):
        for case, settings in study.all_cases.items():
            if seed not in study.instruments.get(case, study.seeds):
                continue
            chosen = (*study.settings, *overrides, *settings, f"twin.seed={seed}")
            try:
                rig_file, _ = load_twin_file(rig, chosen)
            except InputError as error:
                raise InputError(f"case {case} of study {study.name}: {error}") from None
            for repeat in range(1, study.repeats.get(case, 1) + 1):
                name = study.name if repeat == 1 else f"{study.name} {repeat}"
                kind = study.kinds.get(case, study.kind)
                runs.append(Run(case, seed, repeat, kind, rig, chosen, name, rig_file.settings_sha256))
    return runs


def execute(run: Run) -> Outcome:
    """Do one run; an InputError of the experiment is a result. The figures do not hang on the number of threads.

    Raises
    ------
    InputError
        If rig and overrides mean other settings here than where the run was drawn up, or a file cannot be written.
    """
    if load_rig_file(run.rig, run.overrides).settings_sha256 != run.settings_sha256:
        raise InputError(
            f"rig {run.rig} has other settings on {platform.node()} than where the study was begun: "
            "install the same greenough there, and keep rig files under the same path"
        )
    measure = experiment(run.kind)
    start = time.perf_counter()
    with threadpool_limits(1):  # the order in which BLAS sums, and the last digits with it, hang on its threads
        try:
            figures, failure = measure(run.rig, run.overrides, run.name, lambda amount: None), None
        except FileError:  # says nothing about this instrument
            raise
        except InputError as error:
            figures, failure = [], str(error)
    return Outcome([_plain(line) for line in figures], failure, time.perf_counter() - start, _versions())


def keep(folder: Path, run: Run, outcome: Outcome) -> None:
    """Write one result to ``folder``, whole or not at all; figures that are not finite as null.

    Raises InputError where nothing can be written.
    """
    document = asdict(run) | asdict(outcome)
    with atomic_path(folder / run.file_name) as temporary:
        temporary.write_text(json.dumps(nan_as_null(document), indent=1, allow_nan=False), encoding="utf-8")


def kept(folder: Path, run: Run) -> Outcome | None:
    """The result of a run that is done; None of one that is not.

    Raises InputError for a file that is not a result.
    """
    path = folder / run.file_name
    if not path.exists():
        return None
    with reading(path):
        content = path.read_bytes()
    try:
        document = json.loads(content.decode("utf-8"))
        lines = [{name: math.nan if value is None else value for name, value in line.items()}
                 for line in document["figures"]]  # fmt: skip
        return Outcome(lines, document["failure"], document["seconds"], document["versions"])
    except (ValueError, KeyError, TypeError, AttributeError):
        raise InputError(f"{path} is damaged or is not the result of a run: remove it, and it is done again") from None


def _plain(line: Mapping[str, Any]) -> Figures:
    """Texts as they are, numbers as float, whatever NumPy calls them."""
    return {name: value if isinstance(value, str) else float(value) for name, value in line.items()}


def nan_as_null(value: Any) -> Any:
    """The same of nested lists and mappings; JSON knows no numbers that are not finite."""
    if isinstance(value, dict):
        return {name: nan_as_null(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [nan_as_null(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


@cache
def _versions() -> dict[str, str]:
    return {"python": platform.python_version()} | {name: version(name) for name in PACKAGES}
