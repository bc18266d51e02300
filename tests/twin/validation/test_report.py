"""Claims about the report: complete, self-contained, safe, and its maps agree with the errors that were made."""

import base64
import io
import re
from types import SimpleNamespace
from urllib.parse import unquote

import numpy as np
import pytest
from PIL import Image

from greenough.pipeline.compare import ErrorRow
from greenough.pipeline.reconstruct import PointMap
from greenough.pipeline.report.colours import VOID
from greenough.twin import Truth
from greenough.twin.validation import report
from greenough.twin.validation.noise import PlaneNoise
from greenough.twin.validation.pitch import MeasuredBoard
from greenough.twin.validation.report import write_report
from greenough.twin.validation.specimen_maps import SpecimenMaps, specimen_maps
from greenough.twin.validation.specimens import Measured

SHAPE = (48, 64)


def maps(name: str = "coin", **changes: object) -> SpecimenMaps:
    generator = np.random.default_rng(3)
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]]
    values = {
        "treatment": "raw",
        "filter": "none",
        "origin": (100, 200),
        "background": generator.uniform(0, 200, SHAPE),
        "xyz": np.stack([0.1 * u, -0.1 * v, generator.normal(0, 0.1, SHAPE)], axis=-1),
        "error_um": generator.normal(0, 2, SHAPE),
        "smooth": generator.random(SHAPE) < 0.8,
        "sigma_noise_um": np.full(SHAPE, 1.5),
        "sigma_calibration_um": np.full((12, 16), 0.3),
    }
    return SpecimenMaps(name, **(values | changes))


@pytest.fixture
def page(analytic, tmp_path, monkeypatch):
    """Writes a report and returns its text; what a calibration says of itself is tested with the pipeline."""
    monkeypatch.setattr(report, "calibration_part", lambda setup, for_papers: [])

    def written(claims=None, specimens=None, facts=None, pictures=None) -> str:
        setup = analytic()
        raw, second, two, filtered = np.random.default_rng(4).normal(0, 2e-3, (4, *SHAPE))
        noise = PlaneNoise(raw, second, two, filtered, 2e-3, 1e-3, xy=np.zeros((*SHAPE, 2)))
        centres = setup.bench.printed_centres
        centres = np.column_stack([centres[:, :2], np.zeros(len(centres))])
        spots = SimpleNamespace(centres_px=np.full((99, 2), 20.0), seen=np.ones(99, bool))
        board = MeasuredBoard("board", "pitch", np.full(SHAPE, 90.0), spots, [centres], [1e-4])
        rows = [setup.claim("depth", "plane", 3.0, "um", 1234, "95 %", limit=4.0, paper=4.0)]
        path = tmp_path / "report.html"
        write_report(
            path, rows if claims is None else claims(setup), setup, noise, board,
            [maps()] if specimens is None else specimens, facts or {}, pictures,
        )  # fmt: skip
        assert set(tmp_path.iterdir()) == {path} | ({pictures} if pictures else set())
        return path.read_text(encoding="utf-8")

    return written


def pictures_of(text: str) -> dict[str, str]:
    """The SVG of each panel by what it shows."""
    found = re.findall(r'<img src="data:image/svg\+xml,([^"]+)" alt="([^"]*)">', text)
    return {alt: unquote(svg.replace("&#39;", "'")) for svg, alt in found}


def test_page_stands_alone(page):
    text = page()
    assert not re.findall(r"(?:src|href)=\"(?!data:image/svg\+xml,|#)", text)
    pictures = pictures_of(text)
    assert len(re.findall("<img ", text)) == 1 + 4 + 4 + 6  # beside the verdict, plane, board and coin
    for alt in ("departure from the best plane, filtered", "vertical error", "measured height", "σ z by noise"):
        inside = re.findall(r"href='data:image/png;base64,([^']+)'", pictures[alt])
        assert len(inside) == 2, "the map and its bar"
        png = np.asarray(Image.open(io.BytesIO(base64.b64decode(inside[0]))))
        assert png.shape == SHAPE
        assert (png != VOID).all()
    assert "Histogram of the errors" in pictures


@pytest.mark.slow
def test_figures_for_papers_lie_in_their_folder(page, tmp_path):
    page(pictures=tmp_path / "figures")
    names = {path.name for path in (tmp_path / "figures").iterdir()}
    assert {
        "plane-filtered.png",
        "board-distances.png",
        "coin-error.png",
        "coin-sigma-1.png",
        "coin-relief.png",
    } <= names
    assert len(names) == 15


def test_only_rows_that_are_not_as_expected_are_marked(page):
    def claims(setup):
        yield setup.claim("held", "plane", 3.0, "um", 1, "", limit=4.0)
        yield setup.claim("doomed", "plane", 9.0, "um", 1, "", limit=4.0, predicted=8.0)
        yield setup.claim("reported", "plane", 9.0, "um", 1, "")
        yield setup.claim("broken", "plane", 9.0, "um", 1, "", limit=4.0)
        yield setup.claim("lucky", "plane", 1.0, "um", 1, "", limit=4.0, predicted=8.0)
        yield setup.claim("open", "plane", 4.1, "um", 1, "", limit=4.0, predicted=3.9, predicted_sd=0.1)

    text = page(claims=lambda setup: list(claims(setup)))
    marked = re.findall(r'<tr class="unexpected">\s*<td>\w+ <small>(\w+)</small>', text)
    assert marked == ["broken", "lucky"]
    assert "broken (plane), lucky (plane)" in re.sub(r"\s+", " ", text)
    assert all(f"<small>{name}</small>" in text for name in ("held", "doomed", "reported", "open"))
    assert re.findall(r"<td>either</td>", text) == ["<td>either</td>"]
    assert "± 0.1" in text


def test_the_page_opens_with_the_verdict_and_one_picture_and_folds_all_rows(page):
    text = page()
    lead, contents, folded = text.index('class="lead pictured"'), text.index("<nav"), text.index("<details>")
    assert lead < text.index("depth error 95 %") < text.index('alt="coin, measured height"') < contents < folded
    assert text.count("not measured</td>") > 10  # the rows of this page are not those of the paper's claims
    assert folded < text.index("All 1 rows, by specimen") < text.index("<small>depth</small>")


def test_a_page_without_surprises_says_so(page):
    assert "all of these behave as expected" in page()


def test_words_from_outside_are_text_and_no_markup(page):
    text = page(facts={"settings": ["<script>alert(1)</script>"]})
    assert "<script>alert" not in text
    assert len(re.findall("<script", text)) == 3  # the page's own, the palettes and the coin
    assert "&lt;script&gt;alert(1)&lt;/script&gt;" in text


def test_header_names_instrument_and_versions(page):
    text = page(facts={"rig": "mine.toml"})
    for expected in ("mine.toml", "0" * 64, "mitsuba 3.", "1280 x 960 px of 9.90 µm", "30 planes 100 µm apart"):
        assert expected in text


@pytest.mark.slow
def test_a_specimen_of_which_nothing_was_measured_is_shown_empty(page):
    nothing = np.full(SHAPE, np.nan)
    empty = maps(xyz=np.full((*SHAPE, 3), np.nan), error_um=nothing, sigma_noise_um=nothing)
    text = page(specimens=[empty, maps("bga", smooth=np.zeros(SHAPE, bool))])
    assert len(re.findall("<img ", text)) == 1 + 4 + 4 + 6 + 6
    assert len(re.findall('class="surface"', text)) == 2


def test_balls_have_a_section_and_a_table_of_measured_and_true_heights(page):
    balls = np.array([[0.4012, 0.4], [np.nan, 0.41]])
    text = page(specimens=[maps("bga", balls_mm=balls)])
    assert "Section through a row of balls" in pictures_of(text)
    row = re.findall(r'<td>(\d+)</td>((?:\s*<td class="number">[^<]*</td>)+)', text)
    cells = {ball: re.findall(">([^<]*)<", rest)[::2] for ball, rest in row}
    assert cells == {"0": ["401.20", "400.00", "1.20"], "1": ["–", "410.00", "–"]}


@pytest.mark.slow
def test_the_diaphragms_states_share_the_papers_row_and_column(page):
    states = [maps(f"diaphragm-{state}") for state in ("concave", "equilibrated", "raised")]
    pictures = pictures_of(page(specimens=states))
    row, column = pictures["Heights along image row 124"], pictures["Heights along image column 232"]
    for state in ("concave", "equilibrated", "raised"):
        assert state in row
        assert state in column


def test_the_error_map_is_the_vertical_error_on_a_slope_where_lit_and_seen(analytic):
    """Point and truth lie on one leaning ray; the error is counted along z to the surface, not to the true point."""
    slope, ray = 0.5, np.array([0.1, 0.0, 1.0])
    x, y = np.meshgrid(np.linspace(-1, 1, SHAPE[1]), np.linspace(-1, 1, SHAPE[0]))
    xyz = np.stack([x, y, slope * x], axis=-1)
    normal = np.tile(np.array([-slope, 0, 1]) / np.hypot(slope, 1), (*SHAPE, 1))
    error = np.random.default_rng(5).normal(0, 5e-3, SHAPE)
    # Going t along the ray leads t (1 - slope * 0.1) above the surface.
    points = xyz + (error / (1 - slope * ray[0]))[..., None] * ray
    lit = np.ones(SHAPE, bool)
    lit[:5] = False
    world_from_twin = np.eye(4)
    world_from_twin[2, 3] = -0.3
    truth = Truth(xyz + np.array([0, 0, 0.3]), normal, x, y, lit, world_from_twin)
    background = np.full(SHAPE, 100.0)
    row = ErrorRow("vertical", "smooth", 0, 0.0, 0.0, 0.0, 0.0)
    measured = Measured("s", "raw", background, PointMap(points), 0 * background, truth, lit, row, 1.0)
    result = specimen_maps(analytic(), measured)
    np.testing.assert_allclose(result.error_um[5:], 1e3 * error[5:], atol=1e-4)
    assert np.isnan(result.error_um[:5]).all()
