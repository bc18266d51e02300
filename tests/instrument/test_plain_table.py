"""Claims about tables and sentences for terminals: nothing is wider than it may be, and what is cut says so."""

import pytest

from greenough.instrument.plain_table import first_few, sentence_lines, table_lines


@pytest.mark.parametrize("length", [1, 30, 500])
@pytest.mark.parametrize("columns", [1, 5, 12])
def test_no_line_is_wider_than_the_terminal(length, columns):
    rows = [["x" * length] * columns, ["y"] * columns]
    lines = table_lines(["heading " * 9] * columns, rows, numbers={0}, width=100)
    assert len(lines) == 3
    assert max(map(len, lines)) <= 100


def test_what_fits_is_printed_whole_with_numbers_to_the_right():
    assert table_lines(["name", "n"], [["a", "1"], ["bc", "234"]], numbers={1}) == [
        "name    n",
        "a       1",
        "bc    234",
    ]


def test_what_is_cut_ends_with_an_ellipsis_and_the_widest_column_is_cut_first():
    lines = table_lines(["name", "verdict"], [["a long name " * 12, "fails"]], width=40)
    assert lines[1].endswith("…  fails")
    assert len(lines[1]) <= 40


def test_a_cell_of_several_lines_stays_on_one():
    assert table_lines(["a"], [["one\ntwo"]]) == ["a", "one two"]


def test_a_path_that_is_longer_than_a_line_is_broken_and_not_lost():
    path = "/" + "folder/" * 40
    lines = sentence_lines(f"All is in {path}", 60)
    assert max(map(len, lines)) <= 60
    assert path in "".join(lines)


def test_names_that_do_not_fit_are_counted():
    names = [f"row_{k}" for k in range(50)]
    text = first_few(names, 60, "claims.json")
    assert len(text) <= 60
    assert text.startswith("row_0, row_1")
    shown = text.count("row_")
    assert text.endswith(f" and {50 - shown} more, see claims.json")
    assert first_few(names[:2], 60, "claims.json") == "row_0, row_1"
    assert first_few(["x" * 80], 60, "claims.json") == "see claims.json"
