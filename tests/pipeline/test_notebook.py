"""What the pipeline's results show in a notebook: pictures, facts with units, and no markup from data."""

from dataclasses import replace

import numpy as np
import pytest

from greenough.instrument.contract import RigIdentity
from greenough.pipeline.compare import Comparison, ErrorRow, compare
from greenough.pipeline.decode import PhaseMap, decode
from greenough.pipeline.fringes import PAPER, FringeSet
from greenough.pipeline.point_cloud import Mesh, PointCloud
from greenough.pipeline.reconstruct import PointMap
from notebook_page import MARKUP, Page
from small_calibration import SHAPE, small_calibration, small_uncertainty


def point_map():
    """Twelve pixels, one of them without a point; z rises by 0.1 mm from column to column."""
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]]
    xyz = np.stack([0.01 * u, -0.01 * v, 0.1 * u], axis=-1)
    xyz[1, 2] = np.nan
    noise = np.full((*SHAPE, 3), -2e-3, np.float32)
    return PointMap(xyz, noise, small_uncertainty(sigma_z_mm=5e-4))


def test_a_phase_map_shows_phase_and_modulation():
    found = decode(np.ascontiguousarray(PAPER.patterns(40, 608) // 2), PAPER)
    page = Page(found._repr_html_())
    assert len(page.pictures) == 2
    assert len(np.unique(page.pictures[0].reshape(-1, 3), axis=0)) > 100, "a phase that rises has many colours"
    assert page.facts["valid pixels"] == f"{found.valid.sum():,} of {40 * 608:,} ({found.valid.mean():.1%})"
    assert float(page.facts["median modulation where valid, DN"]) == pytest.approx(63.5, abs=0.5)


def test_a_phase_map_without_a_valid_pixel_is_shown():
    nothing = np.full(SHAPE, np.nan, np.float32)
    page = Page(PhaseMap(nothing, nothing, nothing, np.zeros(SHAPE, bool), nothing, nothing)._repr_html_())
    assert page.facts["valid pixels"] == "0 of 12 (0.0%)"
    assert page.facts["absolute phase, rad"] == "none"


def test_a_point_map_shows_heights_and_uncertainties():
    page = Page(point_map()._repr_html_())
    assert len(page.pictures) == 1
    assert page.facts["points"] == "11 of 12 (91.7%)"
    assert page.facts["z, mm"] == "0 to 0.3"
    assert page.facts["median standard uncertainty of z by noise, µm"] == "2"
    assert page.facts["median standard uncertainty of z by calibration, µm"] == "0.5"


def test_a_cloud_is_a_map_of_heights_with_x_to_the_right_and_y_up():
    x, y = np.meshgrid(np.linspace(-3, 3, 60), np.linspace(-2, 2, 40))
    cloud = PointCloud(np.column_stack([x.ravel(), y.ravel(), ((x > 0) & (y > 0)).ravel().astype(float)]))
    page = Page(cloud._repr_html_())
    assert page.facts["z, mm"] == "0 to 1"
    (picture,) = page.pictures
    yellow = (picture[..., 0] > 220) & (picture[..., 1] > 200) & (picture[..., 2] < 80)
    left = yellow[:, : picture.shape[1] * 3 // 4]  # without the colour bar
    row, col = np.nonzero(left)
    purple = (picture[..., 0] < 90) & (picture[..., 1] < 20) & (picture[..., 2] > 70)
    purple_row, purple_col = np.nonzero(purple[:, : picture.shape[1] * 3 // 4])
    assert row.size > 1000
    assert row.mean() < purple_row.mean()
    assert col.mean() > purple_col.mean()


def test_a_cloud_shows_what_its_file_says_and_no_markup_of_it():
    cloud = PointCloud.from_point_map(point_map(), facts={"sample": MARKUP, MARKUP: "x", "rig": "$\\frac{1}$"})
    page = Page(cloud._repr_html_())
    assert page.facts["it says: sample"] == MARKUP
    assert page.facts[f"it says: {MARKUP}"] == "x"
    assert page.facts["it says: rig"] == "$\\frac{1}$"
    assert page.facts["median standard uncertainty of z by noise, µm"] == "2"


@pytest.mark.parametrize("xyz", [np.empty((0, 3)), np.zeros((1, 3)), np.array([[0, 0, np.nan], [1e9, -1e9, 3]])])
def test_a_cloud_of_few_points_or_odd_ones_is_shown(xyz):
    assert Page(PointCloud(xyz)._repr_html_()).facts["points"] == str(len(xyz))


def test_a_calibration_shows_whose_it_is_and_what_it_leaves():
    calibration = replace(
        small_calibration(),
        identity=RigIdentity(MARKUP, MARKUP, MARKUP, "0" * 64),
        run=MARKUP,
        figures={"spot_noise_px": 0.0123456, MARKUP: MARKUP, "outliers": 3, "postures_without_board": (MARKUP,)},
    )
    left = np.full((2, 35, 2), np.nan)
    left[0, :20] = np.random.default_rng(1).normal(0, 0.02, (20, 2))
    calibration = replace(calibration, residuals=replace(calibration.residuals, spots_px=left))
    page = Page(calibration._repr_html_())
    assert len(page.pictures) == 1
    for name in ("rig", "camera", "projector", "run", MARKUP, "postures without board"):
        assert page.facts[name] == MARKUP
    assert page.facts["spot noise, px"] == "0.01235"
    assert page.facts["outliers"] == "3"


def test_a_calibration_without_residuals_is_shown():
    assert Page(small_calibration()._repr_html_()).facts["method"] == "bundle"


def test_a_comparison_shows_its_rows():
    corners = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    mesh = Mesh(corners, np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32))
    xyz = np.random.default_rng(1).uniform([-0.5, -0.5, 0.003], [0.5, 0.5, 0.003], (100, 3))
    page = Page(compare(PointCloud(xyz, facts={"lit_and_seen": "125"}), mesh)._repr_html_())
    assert ["vertical", "all", "100", "3", "3", "3", "3"] in page.rows
    assert page.facts["of those lit and seen"] == "80.0%"
    assert "shift of the origin, mm" not in page.facts
    aligned = Page(compare(PointCloud(xyz), mesh, "rigid")._repr_html_())
    assert aligned.facts["shift of the origin, mm"].endswith(", -0.003")


def test_no_markup_of_a_comparison_survives():
    row = ErrorRow(MARKUP, MARKUP, 1, *[float("nan")] * 4)
    page = Page(Comparison("none", np.eye(4), [row], 1, None)._repr_html_())
    assert [MARKUP.replace("_", " "), MARKUP, "1", "nan", "nan", "nan", "nan"] in page.rows


@pytest.mark.parametrize("fringes", [PAPER, FringeSet((70, 64, 59), (4, 4, 4), field=1e5), FringeSet((2.5,), (3,))])
def test_a_fringe_set_shows_a_strip_of_every_pattern(fringes):
    page = Page(fringes._repr_html_())
    (picture,) = page.pictures
    assert np.ptp(picture) == 255
    assert page.facts["frames"] == str(fringes.frame_count)
