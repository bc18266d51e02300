"""Claims about the report: complete, self-contained, safe, and its maps agree with the errors that were made."""

import base64
import re

import cv2
import numpy as np
import pytest

from greenough.pipeline.compare import ErrorRow
from greenough.pipeline.reconstruct import PointMap
from greenough.twin import Truth
from greenough.twin.validation.noise import PlaneNoise
from greenough.twin.validation.report import SpecimenMaps, specimen_maps, write_report
from greenough.twin.validation.specimens import Measured

SHAPE = (48, 64)


def maps(name: str = "coin", **changes: np.ndarray) -> SpecimenMaps:
    generator = np.random.default_rng(3)
    values = {
        "background": generator.uniform(0, 200, SHAPE),
        "height_mm": generator.normal(0, 0.1, SHAPE),
        "error_um": generator.normal(0, 2, SHAPE),
        "smooth": generator.random(SHAPE) < 0.8,
    }
    return SpecimenMaps(name, **(values | changes))


@pytest.fixture
def page(analytic, tmp_path):
    """Writes a report and returns its text."""

    def written(claims=None, specimens=None, facts=None) -> str:
        setup = analytic()
        raw, second, two, filtered = np.random.default_rng(4).normal(0, 2e-3, (4, *SHAPE))
        noise = PlaneNoise(raw, second, two, filtered, 2e-3, 1e-3, xy=np.zeros((*SHAPE, 2)))
        rows = [setup.claim("depth", "plane", 3.0, "um", 1234, "95 %", limit=4.0, paper=4.0)]
        path = tmp_path / "report.html"
        write_report(
            path, rows if claims is None else claims(setup), setup, noise,
            [maps()] if specimens is None else specimens, facts or {},
        )  # fmt: skip
        assert list(tmp_path.iterdir()) == [path]
        return path.read_text(encoding="utf-8")

    return written


def test_page_stands_alone(page):
    text = page()
    assert not re.findall(r"(?:src|href)=\"(?!data:image/png;base64,)", text)
    assert "<script" not in text
    pictures = re.findall(r'src="data:image/png;base64,([^"]+)"', text)
    assert len(pictures) == 2  # plane and coin
    for picture in pictures:
        png = cv2.imdecode(np.frombuffer(base64.b64decode(picture), np.uint8), cv2.IMREAD_COLOR)
        assert png is not None
        assert min(png.shape[:2]) > 400


def test_only_rows_that_are_not_as_expected_are_marked(page):
    def claims(setup):
        yield setup.claim("held", "plane", 3.0, "um", 1, "", limit=4.0)
        yield setup.claim("doomed", "plane", 9.0, "um", 1, "", limit=4.0, predicted=8.0)
        yield setup.claim("reported", "plane", 9.0, "um", 1, "")
        yield setup.claim("broken", "plane", 9.0, "um", 1, "", limit=4.0)
        yield setup.claim("lucky", "plane", 1.0, "um", 1, "", limit=4.0, predicted=8.0)
        yield setup.claim("open", "plane", 4.1, "um", 1, "", limit=4.0, predicted=3.9, predicted_sd=0.1)

    text = page(claims=lambda setup: list(claims(setup)))
    marked = re.findall(r'<tr class="unexpected">\s*<td>(\w+)', text)
    assert marked == ["broken", "lucky"]
    assert "broken (plane), lucky (plane)" in re.sub(r"\s+", " ", text)
    assert all(f"<td>{name}<br>" in text for name in ("held", "doomed", "reported", "open"))
    assert re.findall(r"<td>either</td>", text) == ["<td>either</td>"]
    assert "± 0.1" in text


def test_a_page_without_surprises_says_so(page):
    assert "all of these behave as expected" in page()


def test_words_from_outside_are_text_and_no_markup(page):
    text = page(facts={"settings": ["<script>alert(1)</script>"]})
    assert "<script" not in text
    assert "&lt;script&gt;" in text


def test_header_names_instrument_and_versions(page):
    text = page(facts={"rig": "mine.toml"})
    for expected in ("mine.toml", "0" * 64, "mitsuba 3.", "1280 x 960 px of 9.90 µm", "30 planes 100 µm apart"):
        assert expected in text


def test_a_specimen_of_which_nothing_was_measured_is_shown_empty(page):
    nothing = np.full(SHAPE, np.nan)
    text = page(specimens=[maps(height_mm=nothing, error_um=nothing), maps("bga", smooth=np.zeros(SHAPE, bool))])
    assert len(re.findall('src="data:', text)) == 3


def test_the_error_map_is_the_vertical_error_on_a_slope_where_lit_and_seen():
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
    result = specimen_maps(Measured("s", "raw", background, PointMap(points), 0 * background, truth, lit, row, 1.0))
    np.testing.assert_allclose(result.error_um[5:], 1e3 * error[5:], atol=1e-4)
    assert np.isnan(result.error_um[:5]).all()
