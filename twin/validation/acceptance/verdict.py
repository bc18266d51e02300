"""The verdict of an acceptance: does the twin keep its claims, and for each artefact one line."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from greenough.instrument.plain_table import SCREEN_LINES, WIDTH, first_few, sentence_lines, table_lines
from greenough.pipeline.report.row_words import in_words
from greenough.pipeline.report.tables import unit_of
from greenough.pipeline.report.verdict_table import FAILS, HOLDS, NO_LIMIT, NOT_MEASURED, measured_text

from ..judged_table import JudgedTable
from .rows import Row

OTHERS = "others"


@dataclass(frozen=True)
class ArtefactLine:
    """What came of one artefact.

    Parameters
    ----------
    artefact : str
    figure : str
        The row that stands for the artefact, in words.
    measured : str
        Its value with its standard uncertainty, where it states one, and its unit; "-" if it is missing.
    hold, fail, missing, no_limit : int
        Rows that keep to their limit, do not, are not there, and only report.
    verdict : str
        "holds" if none fails or is missing.
    rows : tuple of str
        Names of all rows that belong to it.
    unexpected : bool
        Whether the verdict is another one.
    """

    artefact: str
    figure: str
    measured: str
    hold: int
    fail: int
    missing: int
    no_limit: int
    verdict: str
    rows: tuple[str, ...]
    unexpected: bool


def artefact_lines(
    table: JudgedTable[Row], names_of: Mapping[str, Sequence[str]], headline_of: Mapping[str, str]
) -> list[ArtefactLine]:
    """One line for each artefact, and one for rows of none, if there are any.

    Parameters
    ----------
    table : JudgedTable of Row
    names_of : mapping of str to sequences of str
        The rows of each artefact.
    headline_of : mapping of str to str
        The row that stands for each.
    """
    known = {name for names in names_of.values() for name in names}
    rest = tuple(name for name in [*(row.name for row in table.rows), *table.missing] if name not in known)
    groups = {what: tuple(names) for what, names in names_of.items()} | ({OTHERS: rest} if rest else {})
    return [_line(table, what, names, headline_of.get(what, names[0])) for what, names in groups.items() if names]


def _line(table: JudgedTable[Row], artefact: str, names: tuple[str, ...], headline: str) -> ArtefactLine:
    rows = {row.name: row for row in table.rows if row.name in names}
    shown = rows.get(headline)
    hold, fail, no_limit = (sum(row.holds is verdict for row in rows.values()) for verdict in (True, False, None))
    missing = sum(name in table.missing for name in names)
    verdict = FAILS if fail else NOT_MEASURED if missing else HOLDS if hold else NO_LIMIT
    return ArtefactLine(
        artefact=artefact,
        figure=in_words(headline),
        measured="-" if shown is None else _figure(shown),
        hold=hold,
        fail=fail,
        missing=missing,
        no_limit=no_limit,
        verdict=verdict,
        rows=names,
        unexpected=bool(fail or missing),
    )


def _figure(row: Row) -> str:
    if not math.isfinite(row.value):
        return "-"
    return f"{measured_text(row.value, row.u)} {unit_of(row.unit)}".rstrip()


def plain(lines: Sequence[ArtefactLine]) -> list[dict[str, Any]]:
    """The lines as the table's file has them."""
    return [asdict(line) | {"rows": list(line.rows)} for line in lines]


def sentence(table: JudgedTable[Row]) -> str:
    """Whether the twin keeps its claims, and how many rows hold."""
    judged = sum(row.holds is not None for row in table.rows)
    if table.holds:
        return f"The twin keeps its claims: all {judged} rows with a limit hold." if judged else "No row has a limit."
    failed, missing = len(table.not_holding), len(table.missing)
    return (
        f"The twin does not keep its claims: of {judged} rows with a limit {failed} {'does' if failed == 1 else 'do'} "
        f"not hold, and {missing} {'row is' if missing == 1 else 'rows are'} missing."
    )


def screen_lines(table: JudgedTable[Row], lines: Sequence[ArtefactLine], out: Path) -> list[str]:
    """What is printed at the end: the verdict, a line for each artefact, and where everything else is."""
    cells = [
        (
            line.artefact,
            line.figure,
            line.measured,
            f"{line.hold} of {line.hold + line.fail + line.missing}",
            line.verdict,
        )
        for line in lines
    ]
    printed = [
        *sentence_lines(sentence(table)),
        *table_lines(("artefact", "for example", "measured ± u", "rows hold", "verdict"), cells, numbers={2, 3}),
    ]
    reasons = [f"{name} ({reason})" for name, reason in table.missing.items()]
    for said, names in (("Not holding", table.not_holding), ("Missing", reasons)):
        if names:
            printed += sentence_lines(f"{said}: {first_few(names, 3 * WIDTH, out.name)}.")[:4]
    return [*printed[: SCREEN_LINES - 2], *sentence_lines(f"All {len(table.rows)} rows with their criteria: {out}")[:2]]
