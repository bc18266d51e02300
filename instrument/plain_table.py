"""Tables and sentences for a terminal of a given width: nothing that is printed here is ever wider."""

import textwrap
from collections.abc import Collection, Sequence

WIDTH = 100
"""Columns of a terminal that every verdict fits into."""

SCREEN_LINES = 25
"""Lines of a verdict, so that the prompt and what stood before it stay in sight on a screen of 30."""

_GAP = 2
_LEAST = 6  # characters that are left of the widest cell, however many columns there are


def table_lines(
    columns: Sequence[str], rows: Sequence[Sequence[str]], numbers: Collection[int] = (), width: int = WIDTH
) -> list[str]:
    """Lines of a table under its headings, each at most ``width`` characters long.

    Parameters
    ----------
    columns : sequence of str
    rows : sequence of sequences of str
        Cells in the order of the columns, one line each.
    numbers : collection of int
        Indices of columns that are aligned to the right.
    width : int
        Where the table is wider, the widest columns are cut, and what was cut ends with an ellipsis.
    """
    cells = [[" ".join(cell.split()) for cell in row] for row in (columns, *rows)]
    widths = [max(len(row[k]) for row in cells) for k in range(len(columns))]
    while sum(widths) + _GAP * (len(widths) - 1) > width and max(widths) > _LEAST:
        widths[widths.index(max(widths))] -= 1
    lines = []
    for row in cells:
        shown = [_cut(cell, most) for cell, most in zip(row, widths, strict=True)]
        aligned = (
            cell.rjust(most) if k in numbers else cell.ljust(most)
            for k, (cell, most) in enumerate(zip(shown, widths, strict=True))
        )
        lines.append(_cut((" " * _GAP).join(aligned).rstrip(), width))
    return lines


def sentence_lines(text: str, width: int = WIDTH) -> list[str]:
    """A sentence, wrapped; words that are longer than a line, such as paths, are broken."""
    return textwrap.wrap(text, width, break_long_words=True, break_on_hyphens=False)


def first_few(names: Sequence[str], room: int, file: str) -> str:
    """As many names as ``room`` characters hold, and how many more ``file`` tells; at least the file."""
    for shown in range(len(names), 0, -1):
        rest = len(names) - shown
        text = ", ".join(names[:shown]) + (f" and {rest} more, see {file}" if rest else "")
        if len(text) <= room:
            return text
    return f"see {file}" if names else ""


def _cut(text: str, most: int) -> str:
    return text if len(text) <= most else text[: most - 1] + "…"
