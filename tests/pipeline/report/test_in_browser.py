"""Claims about the page as a browser shows it: it works from a file without a network, and nothing in data executes."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from chromium import Opened, chromium
from greenough.instrument.contract import RigIdentity
from greenough.pipeline.point_cloud import Mesh, PointCloud, write_cloud, write_mesh
from greenough.pipeline.report.page import Page, Section, write_page
from greenough.pipeline.report.results import page_of
from greenough.pipeline.report.surface_view import SurfaceView, error_layer, uncertainty_layer
from greenough.pipeline.report.tables import claims_table, facts_table

pytestmark = pytest.mark.browser

ROWS, COLS, PITCH_MM = 240, 320, 0.02
SLOPE = (0.03, -0.02)
HOSTILE = "<script>window.canary=1</script><img src=x onerror=window.canary=2>\"'><svg onload=window.canary=3>"


@pytest.fixture(scope="module")
def browser():
    with chromium() as opened:
        yield opened


def analytic_height(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """A tilted plane with a dome of a paraboloid, mm."""
    return SLOPE[0] * x + SLOPE[1] * y + np.maximum(0.0, 0.3 - 0.4 * ((x - 0.5) ** 2 + (y + 0.3) ** 2))


def analytic_surface(name: str = "dome") -> SurfaceView:
    v, u = np.mgrid[:ROWS, :COLS].astype(float)
    x, y = PITCH_MM * (u - (COLS - 1) / 2), -PITCH_MM * (v - (ROWS - 1) / 2)
    error = 1e3 * 0.002 * np.sin(3 * x)
    return SurfaceView(name, np.stack([x, y, analytic_height(x, y)], axis=-1), [error_layer(error)], "Filter: none.")


@pytest.fixture(scope="module")
def dome(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("dome") / "dome.html"
    write_page(path, Page("Dome", "A known surface.", [Section("Known")], [analytic_surface()], surfaces_before=0))
    return path


def plotted(tab) -> np.ndarray:
    """The section's profile as it is drawn, (n, 2): along the section and height, in mm."""
    drawn = tab.get_attribute("#profile path.curve", "d")
    return np.array([[float(word) for word in point.split()] for point in re.split("[ML]", drawn)[1:]])


def section_at(tab) -> tuple[int, int]:
    """Column and row that the section passes through, as the page says."""
    found = re.search(r"column (\d+), row (\d+)", tab.inner_text("#where"))
    assert found is not None
    return int(found[1]), int(found[2])


def drawn_share(tab, element: str) -> float:
    """Share of an element's pixels, read from what the browser drew, that have a colour."""
    return tab.evaluate(
        """(element) => {
        const source = document.getElementById(element), copy = document.createElement("canvas");
        [copy.width, copy.height] = [source.width, source.height];
        const context = copy.getContext("2d");
        context.drawImage(source, 0, 0);
        const data = context.getImageData(0, 0, copy.width, copy.height).data;
        let seen = 0;
        for (let i = 3; i < data.length; i += 4) seen += data[i] > 0;
        return seen / (data.length / 4);
        }""",
        element,
    )


def test_a_page_works_from_a_file_without_a_network_and_without_complaint(browser, dome):
    with Opened(browser, dome) as opened:
        assert drawn_share(opened.tab, "space") > 0.15
        assert drawn_share(opened.tab, "map") > 0.95
        assert opened.complaints == []
        assert all(url.startswith(("file:", "data:", "blob:")) for url in opened.requests)


def test_a_click_on_the_map_plots_the_known_surface_along_the_row(browser, dome):
    with Opened(browser, dome) as opened:
        box = opened.tab.locator("#map").bounding_box()
        opened.tab.mouse.click(box["x"] + 0.3 * box["width"], box["y"] + 0.6 * box["height"])
        col, row = section_at(opened.tab)
        assert abs(col - 0.3 * COLS) <= 1.5
        assert abs(row - 0.6 * ROWS) <= 1.5
        along, height = plotted(opened.tab).T
        assert len(along) == COLS
        x, y = along - PITCH_MM * (COLS - 1) / 2, -PITCH_MM * (row - (ROWS - 1) / 2)
        np.testing.assert_allclose(along, PITCH_MM * np.arange(COLS), atol=2e-5)
        np.testing.assert_allclose(height, analytic_height(x, y), atol=6e-5)  # codes of 0.1 um, five digits


def test_a_click_on_the_view_from_above_finds_the_point_under_it(browser, dome):
    with Opened(browser, dome) as opened:
        opened.tab.click("#from-above")
        opened.settle()
        box = opened.tab.locator("#space").bounding_box()
        for along, down in ((0.5, 0.5), (0.4, 0.62)):
            opened.tab.mouse.click(box["x"] + along * box["width"], box["y"] + down * box["height"])
            opened.tab.wait_for_timeout(100)
            col, row = section_at(opened.tab)
            # Whatever the magnification, columns and rows are magnified alike about the middle.
            right, below = (along - 0.5) * box["width"], (down - 0.5) * box["height"]
            assert (col - COLS / 2) * below == pytest.approx((row - ROWS / 2) * right, abs=6 * max(abs(right), 60))
            assert (col < COLS / 2 - 5) == (along < 0.45)
            assert (row > ROWS / 2 + 5) == (down > 0.55)
        _, height = plotted(opened.tab).T
        x = PITCH_MM * (np.arange(COLS) - (COLS - 1) / 2)
        expected = analytic_height(x, -PITCH_MM * (row - (ROWS - 1) / 2))
        np.testing.assert_allclose(height, expected, atol=6e-5)


def test_a_slanting_section_is_the_known_surface_at_the_nearest_pixels(browser, dome):
    with Opened(browser, dome) as opened:
        opened.tab.locator("#direction").fill("35")
        along, height = plotted(opened.tab).T
        col, row = section_at(opened.tab)
        turn = np.radians(35)
        # The section's line through the pixel, from where it enters the picture.
        x0, y0 = PITCH_MM * (col - (COLS - 1) / 2), -PITCH_MM * (row - (ROWS - 1) / 2)
        high, wide = PITCH_MM * (ROWS - 1) / 2, PITCH_MM * (COLS - 1) / 2
        back = min((x0 + wide) / np.cos(turn), (y0 + high) / np.sin(turn))
        x, y = x0 + (along - back) * np.cos(turn), y0 + (along - back) * np.sin(turn)
        assert np.ptp(along) == pytest.approx(min(2 * wide / np.cos(turn), 2 * high / np.sin(turn)), rel=0.05)
        # Nearest pixels lie within half a pixel's diagonal of the line.
        steepest = np.hypot(*SLOPE) + 0.7
        np.testing.assert_allclose(height, analytic_height(x, y), atol=steepest * PITCH_MM / np.sqrt(2))
        assert np.abs(height - analytic_height(x, y)).mean() < 2e-3


def test_colour_and_exaggeration_change_what_is_drawn_and_the_bar_has_its_unit(browser, dome):
    with Opened(browser, dome) as opened:
        seen = [opened.tab.locator("#space").screenshot()]
        assert opened.tab.inner_text("#high").endswith("mm")
        opened.tab.select_option("#layer", "error")
        opened.settle()
        seen.append(opened.tab.locator("#space").screenshot())
        assert opened.tab.inner_text("#high") == "2.0 µm"
        assert opened.tab.inner_text("#low") == "−2.0"
        assert np.abs(plotted(opened.tab)[:, 1]).max() == pytest.approx(2.0, abs=0.05)
        opened.tab.locator("#stretch").fill("0.1")
        opened.settle()
        seen.append(opened.tab.locator("#space").screenshot())
        assert len(set(seen)) == 3
        assert opened.complaints == []


def test_a_section_is_saved_for_other_programs(browser, dome):
    with Opened(browser, dome) as opened:
        with opened.tab.expect_download() as started:
            opened.tab.click("#save")
        lines = started.value.path().read_text().splitlines()
        assert started.value.suggested_filename == "section.csv"
        assert lines[0] == "along the section (mm),height (mm)"
        saved = np.array([[float(word) for word in line.split(",")] for line in lines[1:]])
        np.testing.assert_array_equal(saved, plotted(opened.tab))
        assert opened.complaints == []


def test_all_can_be_done_by_keys(browser, dome):
    with Opened(browser, dome) as opened:
        reached = []
        for _ in range(13):
            opened.tab.keyboard.press("Tab")
            reached.append(opened.tab.evaluate("document.activeElement.id"))
        wanted = ["surface", "layer", "stretch", "direction", "from-above", "reset", "save", "space", "map"]
        assert [name for name in reached if name in wanted] == wanted
        before = opened.tab.locator("#space").screenshot()
        opened.tab.focus("#space")
        opened.tab.keyboard.press("ArrowLeft")
        opened.settle()
        assert opened.tab.locator("#space").screenshot() != before
        opened.tab.focus("#map")
        col, row = section_at(opened.tab)
        opened.tab.keyboard.press("ArrowDown")
        opened.tab.keyboard.press("Shift+ArrowRight")
        assert section_at(opened.tab) == (col + 20, row + 1)


def test_light_and_dark_differ_in_page_and_figures(browser, tmp_path):
    path = tmp_path / "cloud.ply"
    write_cloud(path, PointCloud(analytic_surface().xyz.reshape(-1, 3), np.argwhere(np.ones((ROWS, COLS)))))
    page = page_of(path, None, for_papers=False)
    write_page(tmp_path / "page.html", page)
    looks = {}
    for scheme in ("light", "dark"):
        with Opened(browser, tmp_path / "page.html", scheme=scheme) as opened:
            looks[scheme] = opened.tab.locator("body").screenshot(), opened.tab.locator("figure").screenshot()
            back, ink = opened.tab.evaluate("(s => [s.backgroundColor, s.color])(getComputedStyle(document.body))")
            luminance = [sum(map(int, re.findall(r"\d+", colour))) for colour in (back, ink)]
            assert (luminance[0] > luminance[1]) == (scheme == "light")
            assert abs(luminance[0] - luminance[1]) > 400
    assert looks["light"][0] != looks["dark"][0]
    assert looks["light"][1] != looks["dark"][1]


def claim(**changes) -> dict:
    row = {
        "claim": "depth_of_something_with_a_long_name", "specimen": "plane", "paper": 4.0, "measured": 3.0,
        "unit": "um", "n": 1234567, "filter": "plane under a gaussian on phasors, fwhm 4.31 px", "alignment": "none",
        "calibration": "bundle", "seed": 1, "limit": 4.0, "holds": True, "expected_to_hold": True,
        "criterion": "95 % of the vertical errors where the surface is smooth", "predicted": 2.9,
        "predicted_sd": 0.1,
    }  # fmt: skip
    return row | changes


def test_at_a_phones_width_tables_scroll_and_the_page_does_not(browser, tmp_path):
    table = claims_table([claim() for _ in range(30)])
    facts = facts_table({"settings, SHA-256": "0" * 64, "a": "long " * 40}, "facts")
    sections = [Section("Claims", "text " * 50, tables=[table, facts])]
    write_page(tmp_path / "page.html", Page("A title", "A summary.", sections, [analytic_surface()]))
    with Opened(browser, tmp_path / "page.html", width=390) as opened:
        opened.tab.click("summary")
        assert opened.tab.evaluate("document.documentElement.scrollWidth") == 390
        assert opened.tab.evaluate("(t => t.scrollWidth > t.clientWidth)(document.querySelector('.tall'))")
        sizes = "[...document.querySelectorAll('p, td, text')].map((e) => parseFloat(getComputedStyle(e).fontSize))"
        assert min(opened.tab.evaluate(sizes)) >= 11


def test_rows_are_folded_until_asked_for_and_can_be_searched_by_name_and_word(browser, tmp_path):
    table = claims_table([claim(claim=f"row_{k}", specimen=s) for k in range(12) for s in ("plane", "coin")])
    write_page(tmp_path / "page.html", Page("A title", "A summary.", [Section("Claims", tables=[table])]))
    with Opened(browser, tmp_path / "page.html") as opened:
        assert not opened.tab.is_visible("input.rows")
        assert not opened.tab.is_visible("tbody tr")
        opened.tab.click("summary")
        shown = "[...document.querySelectorAll('tbody tr{}')].filter((row) => row.checkVisibility()).length"
        assert opened.tab.evaluate(shown.format(":not(.group)")) == 24
        for words in ("row_11 coin", "row 11 coin"):
            opened.tab.fill("input.rows", words)
            assert opened.tab.evaluate(shown.format(":not(.group)")) == 1
            assert opened.tab.evaluate(shown.format(".group")) == 1
            assert opened.tab.inner_text(".search output") == "1 of 24"


LINE = {
    "claim": "diaphragm equilibrated 95 %, filtered", "unit": "um", "paper": 1.223, "measured": 2.345,
    "uncertainty": 0.012, "truth": None, "limit": 4.0, "bound": "at most", "predicted": 2.3,
    "verdict": "fails, as predicted", "unexpected": False,
}  # fmt: skip


def write_demo(folder: Path, lines: int = 20) -> Path:
    """A folder as of a demo: a verdict, many rows, and one specimen, the dome."""
    rows = [claim(claim=f"row_{k}") for k in range(200)]
    document = {"verdict": [LINE] * (lines - 1) + [LINE | {"unexpected": True}], "claims": rows, "environment": {}}
    (folder / "claims.json").write_text(json.dumps(document))
    points = analytic_surface().xyz.reshape(-1, 3)
    write_cloud(folder / "coin.ply", PointCloud(points, np.argwhere(np.ones((ROWS, COLS))), facts={"filter": "none"}))
    corners = np.array([[-9.0, -9, 0], [9, -9, 0], [9, 9, 0], [-9, 9, 0]])
    write_mesh(folder / "coin-truth.ply", Mesh(corners, np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32)))
    return folder


def box(tab, selector: str) -> dict:
    return tab.locator(selector).first.bounding_box()


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("what", ["", "claims.json"], ids=["folder", "table"])
def test_the_first_screen_shows_the_verdict_and_one_picture(browser, tmp_path, scheme, what):
    result = write_demo(tmp_path) / what
    write_page(tmp_path / "page.html", page_of(result, None, for_papers=False))
    with Opened(browser, tmp_path / "page.html", width=1400, scheme=scheme) as opened:
        assert opened.tab.evaluate("window.scrollY") == 0
        last, picture = box(opened.tab, ".lead tbody tr:last-child"), box(opened.tab, ".lead figure img")
        assert last["y"] + last["height"] < 900
        assert picture["y"] + picture["height"] < 900
        assert picture["height"] > 200
        assert picture["x"] >= last["x"] + last["width"]
        assert opened.tab.locator(".lead figure img").count() == 1
        assert opened.complaints == []


def test_at_a_phones_width_the_verdict_fits_beside_nothing(browser, tmp_path):
    write_page(tmp_path / "page.html", page_of(write_demo(tmp_path), None, for_papers=False))
    with Opened(browser, tmp_path / "page.html", width=390) as opened:
        assert opened.tab.evaluate("document.documentElement.scrollWidth") == 390
        assert opened.tab.evaluate("(s => s.scrollWidth <= s.clientWidth)(document.querySelector('.lead .scroll'))")


def hostile_pages(folder: Path, calibration) -> list[Path]:
    """Results of which every word that can come from outside is markup."""
    cloud = folder / "a<img src=x onerror=window.canary=4>.ply"
    facts = {"sample": HOSTILE, HOSTILE.replace("=", "-"): "value", "filter": HOSTILE}
    flat = analytic_surface().xyz.reshape(-1, 3)
    write_cloud(cloud, PointCloud(flat, np.argwhere(np.ones((ROWS, COLS))), facts=facts))
    row = claim(**{name: HOSTILE for name in ("claim", "specimen", "unit", "filter", "alignment", "criterion")})
    environment = {HOSTILE: HOSTILE, "packages": {HOSTILE: [HOSTILE]}}
    claims = folder / "claims.json"
    verdict = [{name: HOSTILE for name in LINE}, LINE | {"claim": HOSTILE, "verdict": HOSTILE, "unit": HOSTILE}]
    claims.write_text(
        json.dumps({"verdict": verdict, "claims": [row, row | {"holds": False}], "environment": environment})
    )
    accepted = folder / "acceptance.json"
    rows = [{"name": HOSTILE, "criterion": HOSTILE, "unit": HOSTILE, "holds": False, "value": HOSTILE}]
    lines = [{"artefact": HOSTILE, HOSTILE: HOSTILE, "hold": 1, "fail": 0, "missing": 0, "rows": [HOSTILE]}]
    accepted.write_text(
        json.dumps({"verdict": lines, "rows": rows, "missing": {HOSTILE: HOSTILE}, "environment": environment})
    )
    identity = RigIdentity(HOSTILE, HOSTILE, HOSTILE, HOSTILE)
    calibrated = folder / "calibration.h5"
    calibration(identity=identity, run=HOSTILE, figures={"method": HOSTILE, HOSTILE: HOSTILE}).save(calibrated)
    pages = []
    for k, result in enumerate((cloud, claims, accepted, calibrated)):
        page = page_of(result, None, for_papers=False)
        view = replace(analytic_surface(HOSTILE), note=f"{HOSTILE}</script>{HOSTILE}")
        pages.append(folder / f"{k}.html")
        write_page(pages[-1], replace(page, title=HOSTILE, surfaces=[view, *page.surfaces]))
    return pages


def test_no_markup_from_data_ever_executes(browser, tmp_path, calibration):
    for path in hostile_pages(tmp_path, calibration):
        with Opened(browser, path) as opened:
            opened.tab.select_option("#surface", index=0)
            opened.settle()
            assert opened.tab.title() == HOSTILE
            assert HOSTILE in opened.tab.inner_text("#note")
            assert opened.tab.evaluate("typeof window.canary") == "undefined"
            assert opened.tab.evaluate("document.querySelectorAll('img[onerror], svg[onload]').length") == 0
            assert opened.complaints == []


def test_the_policy_stops_what_escaping_would_have_missed(browser, dome):
    """Markup that did get into the page would not run either."""
    with Opened(browser, dome) as opened:
        opened.tab.evaluate(
            """() => {
            document.body.insertAdjacentHTML("beforeend", '<img src="data:," onerror="window.canary = 1">');
            const script = document.createElement("script");
            script.textContent = "window.canary = 2";
            document.body.append(script);
            }"""
        )
        opened.tab.wait_for_timeout(300)
        assert opened.tab.evaluate("typeof window.canary") == "undefined"
        assert any("Content Security Policy" in text for text in opened.complaints)


def test_a_full_picture_of_points_stays_small_and_fluid(browser, tmp_path, record_property):
    """1.2 million points of a noisy surface with error and both uncertainties."""
    rng = np.random.default_rng(1)
    v, u = np.mgrid[:960, :1280].astype(float)
    x, y = 0.01 * (u - 639.5), -0.01 * (v - 479.5)
    noise = rng.normal(0, 1.6e-3, x.shape)
    layers = [error_layer(1e3 * noise), uncertainty_layer("σ z by noise", rng.normal(1.6, 0.05, x.shape))]
    layers.append(uncertainty_layer("σ z by calibration", 0.3 + 0.001 * x))
    view = SurfaceView("full", np.stack([x, y, 0.1 * np.cos(x) + 0.05 * y + noise], axis=-1), layers)
    path = tmp_path / "page.html"
    write_page(path, Page("Full", "1.2 million points.", [Section("A")], [view]))
    assert path.stat().st_size < 15e6
    record_property("bytes", path.stat().st_size)
    with Opened(browser, path) as opened:
        opened.tab.locator("#space").scroll_into_view_if_needed()
        box = opened.tab.locator("#space").bounding_box()
        opened.tab.evaluate(
            """() => { window.frames_drawn = []; const next = (now) => { window.frames_drawn.push(now);
            requestAnimationFrame(next); }; requestAnimationFrame(next); }"""
        )
        opened.tab.mouse.move(box["x"] + 200, box["y"] + 200)
        opened.tab.mouse.down()
        strides = set()
        for k in range(40):
            opened.tab.mouse.move(box["x"] + 200 + 5 * k, box["y"] + 200 + k)
            strides.add(int(opened.tab.get_attribute("#space", "data-stride")))
        opened.tab.mouse.up()
        times = np.diff(opened.tab.evaluate("window.frames_drawn"))
        record_property("frames_per_second", float(1e3 / np.median(times)))
        print(f"\n{1e3 / np.median(times):.0f} frames/s in software, every {sorted(strides)}th point while moving")
        assert max(strides) > 1, "fewer points are drawn while the view moves"
        assert np.median(times) < 400
        opened.settle()
        assert opened.tab.get_attribute("#space", "data-stride") == "1", "and all of them when it rests"
        assert drawn_share(opened.tab, "space") > 0.1
        assert opened.complaints == []
