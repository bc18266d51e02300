"""The figures of a study over its instruments: statistics, limits, and tables for reading."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from itertools import groupby

import numpy as np

from ..benchmarks.rows import Row
from ..hit_rates import acceptable_hits, agreement
from . import ablation
from .runs import Outcome, Run
from .study_file import StudyFile

FALSE_ALARM = 0.01
"""Chance that any of a study's rates is refused although all are what they should be; the same of its agreements."""

UNITS = {"um": "µm", "mm": "mm", "px": "px", "deg": "°", "rad": "rad", "ppm": "ppm", "s": "s", "min": "min"}


@dataclass(frozen=True)
class Statistics:
    """One figure of one line over all runs of a case.

    Parameters
    ----------
    case : str
    line : str
        Texts that tell the line from others of the same run, for example the calibration's method.
    figure : str
    n : int
        Runs in which it was measured.
    missing : int
        Runs in which it could not be, failed ones included.
    mean, sd, rms : float
        Over the n; sd is NaN for a single run.
    p95, max : float
        Of the absolute values.
    """

    case: str
    line: str
    figure: str
    n: int
    missing: int
    mean: float
    sd: float
    rms: float
    p95: float
    max: float

    @property
    def title(self) -> str:
        """All three names."""
        return ", ".join(filter(None, (self.case, self.line, self.figure)))


Finished = Sequence[tuple[Run, Outcome]]


def statistics(finished: Finished) -> list[Statistics]:
    """Of every case, line and figure, in the order of their first appearance."""
    runs = {
        case: sum(run.case == case for run, _ in finished) for case in dict.fromkeys(run.case for run, _ in finished)
    }
    values: dict[tuple[str, str, str], list[float]] = {}
    for run, line, figure, value in _values(finished):
        values.setdefault((run.case, line, figure), []).append(value)
    return [_statistics(*key, np.array(found), runs[key[0]]) for key, found in values.items()]


def _values(finished: Finished) -> Iterable[tuple[Run, str, str, float]]:
    for run, outcome in finished:
        for line in outcome.figures:
            name = ", ".join(value for value in line.values() if isinstance(value, str))
            yield from ((run, name, figure, value) for figure, value in line.items() if not isinstance(value, str))


def _statistics(case: str, line: str, figure: str, values: np.ndarray, runs: int) -> Statistics:
    known = values[np.isfinite(values)]
    n = len(known)
    nan = math.nan
    return Statistics(
        case=case,
        line=line,
        figure=figure,
        n=n,
        missing=runs - n,
        mean=float(known.mean()) if n else nan,
        sd=float(known.std(ddof=1)) if n > 1 else nan,
        rms=float(np.sqrt(np.mean(known**2))) if n else nan,
        p95=float(np.quantile(np.abs(known), 0.95)) if n else nan,
        max=float(np.abs(known).max()) if n else nan,
    )


def rows(study: StudyFile, finished: Finished, found: Sequence[Statistics]) -> list[Row]:
    """What must hold: no run failed, every limit, every rate and every agreement of the study.

    A limit holds if the root mean square over all runs of the case reaches it at most, and not where a run has no such
    figure, or no run at all. Of two limits for one figure that of its line or case counts.
    """
    failed = sum(outcome.failure is not None for _, outcome in finished)
    result = [Row("failed runs", failed, "", limit=0, holds=failed == 0)]
    used = set()
    for each in found:
        names = [f"{each.case}.{each.figure}", f"{each.line}.{each.figure}", each.figure]
        name = next((name for name in names if name in study.limits), None)
        if name is not None:
            used.update(set(names) & set(study.limits))
            limit = study.limits[name]
            holds = each.missing == 0 and each.rms <= limit
            result.append(Row(f"{each.title}, rms", each.rms, unit_of(each.figure), limit=limit, holds=holds))
    missing = (name for name in study.limits if name not in used)
    result += [Row(f"{name}, rms", math.nan, unit_of(name), limit=study.limits[name], holds=False) for name in missing]
    return result + _rate_rows(study, finished) + _agreement_rows(study, finished)


def _rate_rows(study: StudyFile, finished: Finished) -> list[Row]:
    """How often each line's figure is 1, over all cases, between what chance leaves."""
    failed = sum(outcome.failure is not None for _, outcome in finished)
    hits: dict[tuple[str, str], list[float]] = {}
    for _, line, figure, value in _values(finished):
        if figure in study.rates:
            hits.setdefault((line, figure), []).append(value)
    result = []
    for (line, figure), values in hits.items():
        n = len(values)
        low, high = acceptable_hits(n, study.rates[figure], FALSE_ALARM / len(hits))
        name = ", ".join(filter(None, (line, figure, "rate")))
        holds = failed == 0 and bool(low <= sum(values) <= high)
        result.append(Row(name, float(np.mean(values)), "", f"{low / n:.4g} to {high / n:.4g}", holds=holds))
    seen = {figure for _, figure in hits}
    return result + [Row(f"{name}, rate", math.nan, "", holds=False) for name in study.rates if name not in seen]


def _agreement_rows(study: StudyFile, finished: Finished) -> list[Row]:
    """Chance of a difference as large as that of each line's figure between two cases."""
    samples: dict[tuple[str, str], dict[str, list[float]]] = {}
    for run, line, figure, value in _values(finished):
        if run.case in study.agree.get(figure, ()):
            samples.setdefault((line, figure), {}).setdefault(run.case, []).append(value)
    result = []
    for (line, figure), of in samples.items():
        first, second = study.agree[figure]
        name = ", ".join(filter(None, (line, figure, f"agreement of {first} and {second}, p")))
        p_value = agreement(of[first], of[second]).p_value if len(of) == 2 else math.nan
        limit = FALSE_ALARM / len(samples)
        result.append(Row(name, p_value, "", limit=limit, holds=p_value >= limit))
    seen = {figure for _, figure in samples}
    return result + [Row(f"{name}, agreement", math.nan, "", holds=False) for name in study.agree if name not in seen]


def unit_of(figure: str) -> str:
    """By the end of its name; none where it says nothing."""
    return UNITS.get(figure.rpartition("_")[2], "")


def tables(study: StudyFile, finished: Finished, found: Sequence[Statistics]) -> dict[str, list[dict[str, object]]]:
    """For reading: of an ablation its two tables for each line, else one for each figure and line, case by case."""
    if study.effects:
        return _ablation_tables(study, finished)
    shown = [each for each in found if not study.figures or each.figure in study.figures]
    result = {}
    for (figure, line), group in groupby(sorted(shown, key=_order(shown)), key=lambda each: (each.figure, each.line)):
        title = f"{figure}, {line}" if line else figure
        columns = ("n", "missing", "mean", "sd", "rms", "p95", "max")
        result[title] = [{study.x: each.case} | {name: asdict(each)[name] for name in columns} for each in group]
    return result


def _order(shown: Sequence[Statistics]):
    figures, lines = (list(dict.fromkeys(getattr(each, name) for each in shown)) for name in ("figure", "line"))
    return lambda each: (figures.index(each.figure), lines.index(each.line))


def _ablation_tables(study: StudyFile, finished: Finished) -> dict[str, list[dict[str, object]]]:
    """From the first repeat of each case, whose noise all share; NaN where a case failed."""
    shared = statistics([(run, outcome) for run, outcome in finished if run.repeat == 1])
    everything = [each for each in statistics(finished) if each.case == ablation.ALL]
    result: dict[str, list] = {}
    for line in dict.fromkeys(each.line for each in shared):
        figures = dict.fromkeys(each.figure for each in shared if each.line == line)
        means = {case: dict.fromkeys(figures, math.nan) for case in study.all_cases}
        for each in shared:
            if each.line == line:
                means[each.case][each.figure] = each.mean
        scatter = dict.fromkeys(figures, math.nan) | {e.figure: e.sd for e in everything if e.line == line}
        alone, off = ablation.tables(study.effects, means, scatter)
        result |= {f"{line}, each effect alone": alone, f"{line}, each effect off": off}
    return result
