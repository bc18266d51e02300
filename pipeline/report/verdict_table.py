"""A verdict as it lies in a result's file, as words and numbers: the same for a page and for a terminal.

The lines of a verdict are plain data, written by whoever knows what was claimed and what is true. Here they are only
put into words.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, TypeGuard

from .tables import MINUS, Cell, Row, Table, text_of, unit_of

HOLDS, FAILS = "holds", "fails"
FAILS_AS_PREDICTED, HOLDS_AGAINST_PREDICTION = "fails, as predicted", "holds, unpredicted"
HOLDS_BORDERLINE, FAILS_BORDERLINE = "holds, borderline", "fails, borderline"
NO_LIMIT, NOT_MEASURED = "has no limit", "not measured"
"""The words of a verdict. Borderline: the limit lies so near to the prediction that chance decides."""

_COUNTED = {
    HOLDS: "hold",
    HOLDS_BORDERLINE: "hold borderline",
    HOLDS_AGAINST_PREDICTION: "hold unpredicted",
    FAILS_AS_PREDICTED: "fail as predicted",
    FAILS_BORDERLINE: "fail borderline",
    FAILS: "fail",
    NO_LIMIT: "without a limit",
    NOT_MEASURED: "not measured",
}

VERDICT_COLUMNS = ("claim", "paper", "measured", "truth/limit", "verdict")
VERDICT_TEXT = (
    "By the bundle calibration and unfiltered unless a line says otherwise. ± is the standard deviation that the row "
    "states for sampling and for what its model leaves to chance; a row without ± states none. “=” stands before a "
    "true value, “≤”, “≥” and “±” before a limit, whose unit is that of the whole line."
)
_NOTHING = "-"
_DIGITS, _LIMIT_DIGITS = 3, 4  # significant ones, of a figure without an uncertainty and of a limit


def verdict_cells(line: Mapping[str, Any]) -> tuple[str, str, str, str, str]:
    """A line of a demo's verdict in words, in the order of `VERDICT_COLUMNS`; "-" stands for nothing."""
    get = line.get
    return (
        str(get("claim")),
        _paper(line),
        measured_text(get("measured"), get("uncertainty"), _digits(line)),
        _reference(line),
        str(get("verdict")),
    )


def measured_text(value: Any, uncertainty: Any, digits: int = _DIGITS) -> str:
    """A figure with so many significant digits, or to the last digit of its uncertainty where one is stated.

    The uncertainty has two digits if it begins with 1 or 2, otherwise one.
    """
    if not is_number(value):
        return _NOTHING
    if not is_number(uncertainty) or uncertainty <= 0:
        return _significant(value, digits)
    first = math.floor(math.log10(uncertainty))
    decimals = -first if uncertainty >= 3 * 10.0**first else 1 - first
    if decimals > 6 or abs(value) >= 1e6 or uncertainty >= 1e6:
        return f"{value:.2e} ± {uncertainty:.1e}"
    decimals = max(decimals, 0)
    return f"{value:.{decimals}f} ± {uncertainty:.{decimals}f}"


def _significant(value: float, digits: int) -> str:
    if value == 0:
        return "0"
    first = math.floor(math.log10(abs(value)))
    if not -5 < first < 6:
        return f"{value:.{digits - 1}e}"
    return f"{value:.{max(digits - 1 - first, 0)}f}"


def _paper(line: Mapping[str, Any]) -> str:
    paper = line.get("paper")
    if not is_number(paper):
        return "no figure"
    sign = "± " if line.get("bound") == "within" else ""
    return f"{sign}{paper:.{_LIMIT_DIGITS}g}"


def _reference(line: Mapping[str, Any]) -> str:
    truth, limit, unit = line.get("truth"), line.get("limit"), unit_of(line.get("unit"))
    if is_number(truth):
        return f"= {_significant(truth, _digits(line))} {unit}".rstrip()
    if not is_number(limit):
        return f"({unit})" if unit else _NOTHING
    sign = {"at least": "≥", "within": "±", "about nominal": "±"}.get(str(line.get("bound")), "≤")
    return f"{sign} {limit:.{_LIMIT_DIGITS}g} {unit}".rstrip()


def verdict_sentence(lines: Sequence[Mapping[str, Any]]) -> str:
    """How many of the paper's claims hold, and what becomes of the others."""
    words = [str(line.get("verdict")) for line in lines]
    order = [*_COUNTED, *dict.fromkeys(word for word in words if word not in _COUNTED)]
    found = [f"{words.count(word)} {_COUNTED.get(word, word)}" for word in order if word in words]
    return f"Paper's claims in {len(words)} lines: {', '.join(found)}."


def verdict_table(lines: Iterable[Mapping[str, Any]]) -> Table:
    """The lines of a demo's verdict; those that behave otherwise than expected are marked."""
    rows = []
    for line in lines:
        claim, paper, measured, reference, verdict = verdict_cells(line)
        predicted = line.get("predicted")
        foretold = ""
        if is_number(predicted) and not is_number(line.get("truth")):
            foretold = _true_minus(
                f"{predicted:.3g}" if verdict == FAILS_AS_PREDICTED else f"predicted {predicted:.3g}"
            )
        rows.append(
            Row(
                [
                    Cell(claim),
                    Cell(_true_minus(paper)),
                    Cell(_true_minus(measured)),
                    Cell(_true_minus(reference)),
                    Cell(verdict, "" if verdict in (HOLDS, NOT_MEASURED) else foretold),
                ],
                marked=line.get("unexpected") is True,
            )
        )
    return Table("Verdict", VERDICT_COLUMNS, rows, frozenset({"paper", "measured", "truth/limit"}))


def counted_table(lines: Sequence[Mapping[str, Any]]) -> Table:
    """A verdict whose lines count rows, as of ``greenough accept``: columns by the names of the first line."""
    shown = [name for name in (lines[0] if lines else ()) if name not in ("rows", "unexpected")]
    rows = [
        Row([Cell(text_of(line.get(name))) for name in shown], marked=line.get("unexpected") is True) for line in lines
    ]
    numbers = frozenset(name for name in shown if all(isinstance(line.get(name), int) for line in lines))
    return Table("Verdict", [name.replace("_", " ") for name in shown], rows, numbers)


def _digits(line: Mapping[str, Any]) -> int:
    digits = line.get("digits")
    return digits if isinstance(digits, int) and 1 <= digits <= 9 else _DIGITS


def _true_minus(text: str) -> str:
    return "–" if text == _NOTHING else text.replace("-", MINUS)


def is_number(value: Any) -> TypeGuard[float]:
    """Whether a value from a file is a finite number, and no larger an integer than a float can be."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    return abs(value) < 1 << 1000 if isinstance(value, int) else math.isfinite(value)
