"""The verdict of a study: how many runs failed, which limits hold, and where everything else is."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from greenough.instrument.plain_table import SCREEN_LINES, WIDTH, sentence_lines, table_lines
from greenough.pipeline.report.verdict_table import FAILS, HOLDS, NO_LIMIT, measured_text

from ..benchmarks.rows import Row
from .study import Summary

MOST_ROWS = 14
"""Lines of rows on the screen; what does not hold comes first."""

MOST_FAILURES = 3


def sentence(summary: Summary, runs: int) -> str:
    """How many runs there were and failed, and how many limits hold."""
    failed, judged = len(summary.failures), [row for row in limits(summary) if row.holds is not None]
    hold = sum(row.holds is True for row in judged)
    text = f"{runs} {'run' if runs == 1 else 'runs'}, {failed or 'none'} failed; "
    if not judged:
        return text + "the study has no limits."
    return text + (f"all {hold} limits hold." if hold == len(judged) else f"{hold} of {len(judged)} limits hold.")


def limits(summary: Summary) -> list[Row]:
    """The rows of the study's own limits, rates and agreements; those that do not hold come first."""
    return sorted((row for row in summary.rows if row.name != "failed runs"), key=lambda row: row.holds is not False)


def screen_lines(summary: Summary, runs: int, folder: Path) -> list[str]:
    """What a study prints at its end: the verdict, a line for each limit, and as many tables as the screen holds."""
    rows = limits(summary)
    printed = sentence_lines(sentence(summary, runs))
    if rows:
        cells = [_cells(row) for row in rows[:MOST_ROWS]]
        printed += table_lines(("limit of", "value", "limit", "verdict"), cells, numbers={1, 2})
        if len(rows) > MOST_ROWS:
            printed.append(f"and {len(rows) - MOST_ROWS} more, see summary.json")
    for each in summary.failures[:MOST_FAILURES]:
        printed += sentence_lines(f"Failed: case {each['case']}, seed {each['seed']}: {each['failure']}")[:1]
    if len(summary.failures) > MOST_FAILURES:
        printed.append(f"and {len(summary.failures) - MOST_FAILURES} more failures, see summary.json")
    last = sentence_lines(f"Tables, rows and statistics are in {folder / 'summary.json'}")[:2]
    left_out = 0
    for title, table in summary.tables.items():
        lines = [*sentence_lines(f"{title}:")[:1], *_table_lines(table)]
        if len(printed) + len(lines) + len(last) + 1 > SCREEN_LINES:
            left_out += 1
        else:
            printed += lines
    if left_out:
        printed.append(f"{left_out} {'table is' if left_out == 1 else 'tables are'} too long for the screen.")
    return printed + last


def _cells(row: Row) -> tuple[str, str, str, str]:
    reference = row.limit if row.limit is not None else row.peer
    limit = "-" if reference is None else reference if isinstance(reference, str) else f"{reference:.4g}"
    verdict = NO_LIMIT if row.holds is None else HOLDS if row.holds else FAILS
    value = "-" if not math.isfinite(row.value) else f"{measured_text(row.value, None)} {row.unit}".rstrip()
    return row.name, value, limit, verdict


def _table_lines(table: Sequence[Mapping[str, Any]]) -> list[str]:
    names = list(dict.fromkeys(name for row in table for name in row))
    rows = [[_text(row.get(name)) for name in names] for row in table]
    return [f"  {line}" for line in table_lines(names, rows, width=WIDTH - 2)]


def _text(value: Any) -> str:
    if value is None or value != value:
        return "-"
    return f"{value:.6g}" if isinstance(value, float) else str(value)
