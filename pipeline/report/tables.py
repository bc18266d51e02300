"""Tables of a report: numbers as text, facts, claims and acceptance rows as they lie in their files."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from .row_words import in_words

NARROW_SPACE, MINUS = "\u202f", "−"


@dataclass(frozen=True)
class Cell:
    """One field of a table: its text, and a remark in small letters that stands beside or below it.

    A ``note`` is another such remark, below both.
    """

    text: str
    small: str = ""
    below: bool = False
    note: str = ""


@dataclass(frozen=True)
class Row:
    """Cells in the order of the columns; ``marked`` rows are shaded."""

    cells: Sequence[Cell]
    marked: bool = False


@dataclass(frozen=True)
class Table:
    """Rows under headings.

    Parameters
    ----------
    label : str
        What the table is, for those who do not see it.
    columns : sequence of str
    rows : sequence of Row
    numbers : set of str
        Columns of numbers, which are aligned to the right.
    tall : bool
        Whether it is so long that it scrolls by itself and can be searched.
    folded : str
        Where it is set, the table is folded under these words until a reader opens it.
    groups : mapping of int to str
        Headings within the table, each by the number of the row that it stands before.
    """

    label: str
    columns: Sequence[str]
    rows: Sequence[Row]
    numbers: frozenset[str] = field(default_factory=frozenset)
    tall: bool = False
    folded: str = ""
    groups: Mapping[int, str] = field(default_factory=dict)


def text_of(value: Any, depth: int = 3) -> str:
    """A value as the page shows it: five digits, a true minus, thousands apart, – for nothing, … below ``depth``."""
    if value is None or value != value:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int):
        return f"{value:,}".replace(",", NARROW_SPACE).replace("-", MINUS)
    if isinstance(value, float):
        return f"{value:.5g}".replace("-", MINUS)
    if isinstance(value, list | tuple | Mapping) and depth == 0:
        return "…"
    if isinstance(value, list | tuple):
        return ", ".join(text_of(item, depth - 1) for item in value) or "–"
    if isinstance(value, Mapping):
        return ", ".join(f"{name} {text_of(item, depth - 1)}" for name, item in value.items()) or "–"
    return str(value)


def fixed(value: float, digits: int) -> str:
    """A number with so many decimals and a true minus; – for NaN."""
    return "–" if value != value else f"{value:.{digits}f}".replace("-", MINUS)


def unit_of(unit: Any) -> str:
    """A unit as it is printed: ``um`` is µm, and 1 is nothing."""
    return {"um": "µm", "1": ""}.get(str(unit), str(unit))


_CLAIM_COLUMNS = (
    "claim", "specimen", "calibration", "paper", "measured", "unit", "limit", "predicted", "holds", "expected", "n",
    "filter", "alignment",
)  # fmt: skip


def is_as_expected(claim: Mapping[str, Any]) -> bool:
    """Whether a claim behaves as it should: held where it should hold, failed where it cannot, or open."""
    return claim.get("expected_to_hold") is None or claim.get("holds") == claim["expected_to_hold"]


def claims_table(claims: Iterable[Mapping[str, Any]]) -> Table:
    """Rows as ``claims.json`` has them, by specimen; those that behave otherwise than expected are marked.

    The table is folded: a verdict stands for it.
    """
    grouped: dict[str, list[Mapping[str, Any]]] = {}
    for claim in claims:
        grouped.setdefault(text_of(claim.get("specimen")), []).append(claim)
    rows, groups = [], {}
    for specimen, of in grouped.items():
        groups[len(rows)] = f"{specimen}: {_counted(of)}"
        rows += [_claim_row(claim) for claim in of]
    return Table(
        "Claims", _CLAIM_COLUMNS, rows, frozenset({"paper", "measured", "limit", "predicted", "n"}), tall=True,
        folded=f"All {len(rows)} rows, by specimen", groups=groups,
    )  # fmt: skip


def _counted(claims: Sequence[Mapping[str, Any]]) -> str:
    judged = sum(claim.get("holds") is not None for claim in claims)
    wrong = sum(not is_as_expected(claim) for claim in claims)
    behave = f"{wrong} otherwise than expected" if wrong else "all as expected" if judged else "only reported"
    return f"{len(claims)} {'row' if len(claims) == 1 else 'rows'}, {judged} with a limit, {behave}"


def _claim_row(claim: Mapping[str, Any]) -> Row:
    get, expected = claim.get, is_as_expected(claim)
    spread = get("predicted_sd")
    either = get("holds") is not None and get("expected_to_hold") is None
    return Row(
        [
            _named(get("claim"), get("criterion")),
            Cell(text_of(get("specimen"))),
            Cell(text_of(get("calibration"))),
            Cell(text_of(get("paper"))),
            Cell(text_of(get("measured"))),
            Cell(unit_of(get("unit"))),
            Cell(text_of(get("limit"))),
            Cell(text_of(get("predicted")), "" if not _number(spread) else f"± {spread:.2g}", below=True),
            Cell(text_of(get("holds"))),
            Cell("either" if either else text_of(get("expected_to_hold")), "" if expected else "(unexpected)"),
            Cell(text_of(get("n"))),
            Cell(text_of(get("filter"))),
            Cell(text_of(get("alignment"))),
        ],
        marked=not expected,
    )


def _named(name: Any, criterion: Any) -> Cell:
    """A row's name in words, beside it in small letters as it is in the file, and below them what the row says."""
    return Cell(in_words(str(name)), text_of(name), note=str(criterion or ""))


_ROW_COLUMNS = (
    "name", "value", "u", "unit", "peer", "ratio", "limit", "holds", "n", "filter", "alignment",
)  # fmt: skip


def acceptance_table(rows: Iterable[Mapping[str, Any]], artefact_of: Mapping[str, str] | None = None) -> Table:
    """Rows as the file of ``greenough accept`` has them, folded; those that do not hold are marked.

    ``artefact_of`` tells by a row's name under which heading it comes; without it there are no headings.
    """
    known = artefact_of or {}
    grouped: dict[str, list[Mapping[str, Any]]] = {}
    for row in rows:
        grouped.setdefault(known.get(str(row.get("name")), "others"), []).append(row)
    made, groups = [], {}
    for artefact, of in grouped.items():
        if known:
            groups[len(made)] = f"{artefact}: {len(of)} {'row' if len(of) == 1 else 'rows'}"
        for row in of:
            cells = [Cell(text_of(row.get(name))) for name in _ROW_COLUMNS]
            cells[0] = _named(row.get("name"), row.get("criterion"))
            cells[_ROW_COLUMNS.index("unit")] = Cell(unit_of(row.get("unit") or ""))
            made.append(Row(cells, marked=row.get("holds") is False))
    return Table(
        "Acceptance", _ROW_COLUMNS, made, frozenset({"value", "u", "peer", "ratio", "limit", "n"}), tall=True,
        folded=f"All {len(made)} rows" + (", by artefact" if known else ""), groups=groups,
    )  # fmt: skip


def facts_table(facts: Mapping[str, Any], label: str) -> Table:
    """Names and values, without headings."""
    rows = [Row([Cell(name.replace("_", " ")), Cell(text_of(value))]) for name, value in facts.items()]
    return Table(label, (), rows)


def _number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)
