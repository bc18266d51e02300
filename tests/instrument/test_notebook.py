"""Results show themselves, and nothing of the data becomes markup."""

import subprocess
import sys

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from greenough.instrument.contract import Frames
from greenough.instrument.notebook import card, map_picture, table
from notebook_page import MARKUP, Page


def frames(count=3, run="friday", dtype=np.uint8):
    stack = np.zeros((count, 40, 60), dtype)
    stack[:, :, 30:] = 200
    stack[:1, :10, 30:40] = 255
    return Frames(stack, 255.0, 4.0, 8333.0, 1.5, 0.25, np.arange(7, 7 + count), np.arange(count) * 0.01, run)


@given(st.text(st.characters(codec="utf-8", exclude_characters="\r\0"), max_size=60))
@example(MARKUP)
def test_any_text_comes_back_from_the_page_as_it_was(text):
    page = Page(card(text, {text: text}) + table([(text,)], [text]))
    assert [line for line in page.rows if line] == [[text, text], [text], [text]]
    assert "".join(page.texts).startswith(text)


def test_what_is_long_is_cut():
    (row,) = Page(table([("x" * 100_000,)])).rows
    assert len(row[0]) < 400


def test_frames_show_pictures_and_how_they_were_taken():
    page = Page(frames(run=MARKUP)._repr_html_())
    (picture,) = page.pictures
    assert np.ptp(picture) > 200
    facts = page.facts
    assert facts["run"] == MARKUP
    assert facts["frames"] == "3"
    assert facts["rows x columns"] == "40 x 60"
    assert facts["exposure, ms"] == "8.333"
    assert facts["pixels saturated in any frame"] == "100 of 2,400 (4.2%)"
    assert facts["frame counter"] == "7 to 9"


@pytest.mark.parametrize("count", [0, 1, 2, 50])
def test_any_number_of_frames_is_shown(count):
    page = Page(frames(count)._repr_html_())
    assert page.facts["frames"] == str(count)
    assert len(page.pictures) == min(count, 1)


@pytest.mark.parametrize(
    "values", [np.full((5, 6), np.nan), np.zeros((5, 6)), np.array([[np.inf, 1.0], [2.0, -np.inf]])]
)
def test_a_map_without_values_or_contrast_is_drawn(values):
    assert map_picture(values, "z, mm").png.startswith(b"\x89PNG")


@pytest.mark.slow
def test_a_spike_does_not_take_the_colours_of_all_others():
    values = np.tile(np.linspace(0, 1, 100), (100, 1))
    values[0, 0] = 1e6
    with_spike, without = (Page(card("", {}, [map_picture(v, "z, mm")])).pictures[0] for v in (values, values[1:]))
    assert len(np.unique(with_spike.reshape(-1, 3), axis=0)) > 0.5 * len(np.unique(without.reshape(-1, 3), axis=0))


def test_the_contract_alone_draws_nothing():
    program = "import sys, greenough.instrument.contract; print([m for m in ('matplotlib', 'PIL') if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
