"""Claims about the page as a file: it stands alone, has a policy that fits it, and keeps words from outside apart."""

import base64
import hashlib
import json
import re

import numpy as np
import pytest

from greenough.instrument.errors import InputError
from greenough.pipeline.report.figures import FIRST, INK, graph
from greenough.pipeline.report.map_panels import map_panel
from greenough.pipeline.report.page import Figure, Page, Section, render, write_page
from greenough.pipeline.report.surface_view import SurfaceView
from greenough.pipeline.report.tables import facts_table


def some_panels(for_papers: bool = False) -> list:
    panels: list = []
    values = np.arange(1200.0).reshape(30, 40)
    map_panel(panels, "a-map", "a map", values, "z (mm)", "viridis", 0.0, 1200.0, for_papers)
    with graph(panels, "a-graph", "a $graph", "x (mm)", "z (µm)", "a graph", for_papers) as axes:
        axes.plot([0, 1], [0, 1], color=FIRST)
    return panels


def some_page(**changes) -> Page:
    surface = SurfaceView("flat", np.stack([*np.mgrid[:9, :9].astype(float), np.zeros((9, 9))], axis=-1))
    sections = [Section("First", figures=[Figure(some_panels(), "caption")], tables=[facts_table({"a": 1}, "facts")])]
    return Page(**({"title": "T", "summary": "S", "sections": sections, "surfaces": [surface]} | changes))


def test_nothing_comes_from_elsewhere():
    text = render(some_page())
    assert not re.findall(r"""(?:src|href)=["'](?!data:|#)""", text)
    assert "@import" not in text
    assert not re.findall(r"https?://(?!www\.w3\.org/(2000/svg|1999/xlink))", text)


def test_the_policy_allows_the_pages_own_script_and_style_by_their_hashes_and_nothing_else():
    text = render(some_page())
    policy = re.search(r'Content-Security-Policy" content="([^"]*)"', text)[1].replace("&#39;", "'")
    rules = dict(rule.split(maxsplit=1) for rule in policy.split(";"))
    assert (rules["default-src"], rules["img-src"]) == ("'none'", "data:")
    for rule, element in (("style-src", "style"), ("script-src", "script")):
        inside = re.search(rf"<{element}>(.*?)</{element}>", text, re.DOTALL)[1]
        assert rules[rule] == f"'sha256-{base64.b64encode(hashlib.sha256(inside.encode()).digest()).decode()}'"


def test_words_from_outside_are_text_and_cannot_end_the_json_that_they_stand_in():
    bad = "</script><script>alert(1)</script>"
    surface = SurfaceView(bad, np.zeros((4, 4, 3)), note=bad)
    text = render(some_page(title=bad, summary=bad, sections=[Section(bad, bad)], surfaces=[surface]))
    assert text.count("<script") == 3  # the page's own, its palettes and one surface
    assert text.count("</script") == 3
    inside = re.search(r'class="surface" data-name="[^"]*">(.*?)</script>', text, re.DOTALL)[1]
    assert json.loads(inside)["note"] == bad


def test_figures_carry_the_colours_of_both_schemes_and_no_other_ink():
    for each in some_panels():
        assert "prefers-color-scheme:dark" in each.svg
        assert INK not in each.svg.partition("</style>")[2]
        assert each.uri.startswith("data:image/svg+xml,%3Csvg")
        assert not set(each.uri) & set('<>"#\n')


def test_pictures_for_papers_lie_beside_it_under_their_names(tmp_path):
    page = some_page(sections=[Section("A", figures=[Figure(some_panels(for_papers=True), "c")])])
    write_page(tmp_path / "page.html", page, tmp_path / "figures")
    assert {path.name for path in tmp_path.iterdir()} == {"page.html", "figures"}
    names = {path.name for path in (tmp_path / "figures").iterdir()}
    assert names == {"a-map.png", "a-graph.png"}
    for name in names:
        assert (tmp_path / "figures" / name).read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"


def test_a_page_that_cannot_be_written_leaves_nothing(tmp_path):
    with pytest.raises(InputError, match="no folder"):
        write_page(tmp_path / "nowhere" / "page.html", some_page())
    assert list(tmp_path.iterdir()) == []
