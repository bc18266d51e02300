"""Claims about a ball grid array, on points whose errors are known."""

import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from greenough.pipeline.compare import ErrorRow, Surface, vertical_errors
from greenough.pipeline.metrology.coplanarity import seating_planes
from greenough.pipeline.point_cloud import Mesh
from greenough.pipeline.reconstruct import PointMap
from greenough.scenes.bga import BallGrid, bga
from greenough.scenes.parts import Specimen, merge, transform
from greenough.twin.validation.balls import BallGridAsMounted, ball_claims
from greenough.twin.validation.measured import DECONVOLVED, DECONVOLVED_FILTERED, FILTERED, RAW, Measured
from greenough.twin.validation.setup import Setup

PIXEL_MM = 0.0099
GRID = BallGrid(rows=3, cols=3, substrate_size=(2.6, 2.6))
SPECIMEN = bga(seed=3, nominal=GRID)
SHIFT = np.eye(4)
SHIFT[:3, 3] = [0.05, -0.03, -0.2]
UP = np.array([0.0, 0.0, 1.0])


@pytest.fixture
def setup(analytic):
    def made(method: str = "bundle", specimen: Specimen = SPECIMEN) -> Setup:
        return analytic(SHIFT, method=method, specimen=specimen)

    return made


def true_points(specimen: Specimen = SPECIMEN) -> np.ndarray:
    """What pixels see of the mounted array from straight above, (rows, cols, 3): spheres and a plane."""
    x, y = np.meshgrid(np.arange(-1.28, 1.28, PIXEL_MM), np.arange(-1.28, 1.28, PIXEL_MM))
    z = np.full(x.shape, specimen.nominal["substrate_z_mm"])
    built = specimen.as_built
    for apex, radius in zip(built["ball_apexes_mm"], built["ball_radii_mm"], strict=True):
        square = radius**2 - (x - apex[0]) ** 2 - (y - apex[1]) ** 2
        z = np.where(square > 0, np.maximum(z, apex[2] - radius + np.sqrt(np.maximum(square, 0))), z)
    return np.stack([x, y, z], axis=-1) + SHIFT[:3, 3]


def measured(
    xyz: np.ndarray, treatment: str = RAW, truth: np.ndarray | None = None, sigma_mm: float = 1e-3
) -> Measured:
    everywhere = np.ones(xyz.shape[:2], bool)
    seen = SimpleNamespace(lit_and_seen=everywhere, xyz_world=true_points() if truth is None else truth)
    sigma = np.full(everywhere.shape, sigma_mm)
    row = ErrorRow("vertical", "smooth", 0, 0.0, 0.0, 0.0, 0.0)
    return Measured("bga", treatment, 0 * sigma, PointMap(xyz), sigma, seen, everywhere, row, 1.0)


def rows(setup: Setup, of: Measured) -> dict:
    return {row.claim: row for row in ball_claims(setup, of)}


def slopes_deg(specimen: Specimen = SPECIMEN) -> np.ndarray:
    """Of each pixel's ball, from its distance from the axis: sin(slope) = distance / radius; 90 beside the balls."""
    x, y = np.moveaxis(true_points()[..., :2] - SHIFT[:2, 3], -1, 0)
    slope = np.full(x.shape, 90.0)
    for apex, radius in zip(specimen.as_built["ball_apexes_mm"], specimen.as_built["ball_radii_mm"], strict=True):
        aside = np.hypot(x - apex[0], y - apex[1]) / radius
        slope = np.where(aside < 1, np.degrees(np.arcsin(np.minimum(aside, 1))), slope)
    return slope


@pytest.mark.slow
def test_apex_errors_are_those_of_the_balls(setup):
    """Nine balls measured too high by 1 to 9 um, on a package that lies shifted and lower."""
    xyz = true_points()
    grid = BallGridAsMounted.of(setup().bench)
    too_high = 1e-3 * np.arange(1, 10)
    xyz[..., 2] += too_high[grid.nearest_ball(grid.in_part(xyz))]
    found = rows(setup(), measured(xyz))
    # Over 15 degrees a sphere departs from its paraboloid by r sin(15)^4 / 8 = 0.14 um at the rim.
    assert found["ball_apex_bias"].measured == pytest.approx(5.0, abs=0.1)
    assert found["ball_apex_sd"].measured == pytest.approx(np.std(np.arange(1, 10), ddof=1), abs=0.02)
    assert found["ball_apex_within_tolerance"].measured == pytest.approx(9.0, abs=0.1)
    assert found["ball_apex_within_tolerance"].holds is None
    assert rows(setup(), measured(xyz, DECONVOLVED))["ball_apex_within_tolerance_deconvolved"].holds is True
    assert {found[name].n for name in ("ball_apex_bias", "ball_apex_sd", "coplanarity_error")} == {9}


@pytest.mark.slow
def test_coplanarity_is_judged_by_the_balls_heights_alone(setup):
    """A package measured too high and leaning is as coplanar as it is; with its worst ball too low it is not."""
    xyz = true_points()
    leaning = xyz + UP * (2e-3 + 1e-3 * xyz[..., :1])
    same = rows(setup(), measured(leaning))
    assert abs(same["coplanarity_error"].measured) < 0.05
    assert abs(same["coplanarity_regression_error"].measured) < 0.05
    grid = BallGridAsMounted.of(setup().bench)
    planes = seating_planes(grid.apexes, np.zeros(2))
    above = planes[:, :1] + planes[:, 1:] @ grid.apexes[:, :2].T - grid.apexes[:, 2]
    worst = np.argmax(above.max(axis=0))
    low = xyz - 5e-3 * UP * (grid.nearest_ball(grid.in_part(xyz)) == worst)[..., None]
    assert rows(setup(), measured(low))["coplanarity_error"].measured == pytest.approx(5.0, abs=0.05)


def test_caps_and_substrate_are_judged_apart(setup):
    """Caps up to 15 degrees 2 um too high with holes, the rest of the balls 30 um, the substrate 1 um too low."""
    slope = slopes_deg()
    error = np.where(slope <= 15, 2e-3, np.where(slope < 90, 30e-3, -1e-3))
    xyz = true_points() + UP * error[..., None]
    hole = (slope <= 15) & (np.arange(xyz.shape[0])[:, None] % 4 == 0)
    xyz[hole] = np.nan
    found = rows(setup(), measured(xyz))
    shares = [np.mean(hole[slope <= steepest]) for steepest in (15, 45)]
    for name, values in (
        ("cap15", (2.0, 2.0, 1 - shares[0])),
        ("substrate", (-1.0, 1.0, 1.0)),
        ("cap45", (None, 30.0, 1 - shares[1])),
    ):
        for row, value in zip(("bias", "p95", "valid_share"), values, strict=True):
            if value is not None:
                assert found[f"{name}_{row}"].measured == pytest.approx(value, abs=2e-3)
    assert found["cap15_p95"].n == np.sum(slope[~hole] <= 15)
    assert found["substrate_valid_share"].n == np.sum(slope == 90)


def test_noise_alone_is_as_predicted(setup):
    """2 um of noise on caps of 1 900 pixels: their 95 % point is known to 0.011 of the share, 4.8 % of the value."""
    rng = np.random.default_rng(1)
    xyz = true_points()
    noisy = xyz + 2e-3 * UP * rng.standard_normal(xyz.shape[:2])[..., None]
    found = rows(setup(), measured(noisy, sigma_mm=2e-3))
    for name, tolerance in (("cap15_p95", 0.25), ("substrate_p95", 0.05)):
        stated = re.search(r"noise alone makes ([\d.]+) um", found[name].criterion)
        assert stated is not None
        assert found[name].predicted is None
        assert found[name].measured == pytest.approx(float(stated[1]), rel=tolerance)
    assert abs(found["ball_apex_bias"].measured) < 1.0


def test_only_where_truth_lies_counts(setup):
    """Points on the caps whose pixels truth sees on the substrate, as behind a blurred edge, are the substrate's."""
    xyz = true_points()
    elsewhere = true_points()
    elsewhere[..., 2] = SHIFT[2, 3] + SPECIMEN.nominal["substrate_z_mm"]
    found = rows(setup(), measured(xyz, truth=elsewhere))
    assert "cap15_p95" not in found
    assert found["substrate_valid_share"].n == xyz[..., 2].size
    assert found["substrate_p95"].measured > 300.0


@pytest.mark.slow
def test_errors_count_where_the_surface_is_smooth_and_shares_where_it_is_lit_and_seen(setup):
    """In the left half nothing is smooth and errors are large; in the upper half nothing is lit nor measured."""
    xyz = true_points()
    rows_, cols_ = (n // 2 for n in xyz.shape[:2])
    xyz[:, :cols_, 2] += 0.04
    xyz[:rows_] = np.nan
    everything = measured(xyz)
    smooth, lit = np.ones((2, *xyz.shape[:2]), bool)
    smooth[:, :cols_], lit[:rows_] = False, False
    truth = SimpleNamespace(lit_and_seen=lit, xyz_world=true_points())
    found = rows(setup(), replace(everything, smooth=smooth, truth=truth))
    assert found["cap15_p95"].measured < 0.01
    assert found["cap15_valid_share"].measured == 1.0
    assert rows(setup(), everything)["cap15_p95"].measured == pytest.approx(40.0, abs=0.1)
    assert rows(setup(), everything)["cap15_valid_share"].measured == pytest.approx(0.5, abs=0.05)


def test_errors_above_balls_are_those_above_their_mesh(setup):
    """The mesh's facets depart from the spheres by less than 0.1 um, more in z where they are steep."""
    grid = BallGridAsMounted.of(setup().bench)
    xyz = true_points()[slopes_deg() <= 45] + 5e-3 * UP
    mesh = Mesh(*merge([transform(part, SHIFT) for part in SPECIMEN.parts]))
    np.testing.assert_allclose(
        grid.errors_above_balls(grid.in_part(xyz)), vertical_errors(xyz, Surface.of(mesh)), atol=1.5e-4
    )


@pytest.mark.slow
def test_limits_are_on_the_treatments_that_earn_them(setup):
    xyz = true_points()
    limited = {
        treatment: {
            row.claim.removesuffix(f"_{treatment}")
            for row in ball_claims(setup(), measured(xyz, treatment))
            if row.limit is not None
        }
        for treatment in (RAW, DECONVOLVED, DECONVOLVED_FILTERED, FILTERED)
    }
    apexes = {
        "ball_apex_bias", "ball_apex_sd", "ball_apex_within_tolerance", "coplanarity_error",
        "coplanarity_regression_error",
    }  # fmt: skip
    surfaces = {"cap15_p95", "cap15_valid_share", "substrate_bias", "substrate_p95", "substrate_valid_share"}
    # What could only be filtered keeps its blur.
    assert limited == {RAW: set(), DECONVOLVED: apexes, DECONVOLVED_FILTERED: surfaces, FILTERED: set()}
    for treatment in limited:
        assert not any(row.limit for row in ball_claims(setup("paper"), measured(xyz, treatment)))


@pytest.mark.slow
def test_rows_with_limits_fail_where_they_are_missed_and_are_expected_to_hold(setup):
    high = measured(true_points() + 4.1e-3 * UP, DECONVOLVED_FILTERED, sigma_mm=0.1)
    found = rows(setup(), high)
    for name in ("cap15_p95", "substrate_p95", "substrate_bias"):
        row = found[f"{name}_deconvolved_filtered"]
        assert (row.holds, row.expected_to_hold) == (False, True)
    apex = rows(setup(), replace(high, treatment=DECONVOLVED))["ball_apex_bias_deconvolved"]
    assert (apex.holds, apex.expected_to_hold) == (False, True)


def test_the_filter_is_predicted_to_lower_apexes_by_its_variance_over_the_radius(setup):
    """FWHM of an Airy diameter, 2 x 0.61 wavelengths / NA, on balls of 0.25 mm: 1.3 um."""
    found = rows(setup(), measured(true_points(), DECONVOLVED_FILTERED))
    variance = (2 * 0.61 * 0.525e-3 / 0.015 / 2.3548) ** 2
    expected = -1e3 * np.mean(variance / SPECIMEN.as_built["ball_radii_mm"])
    assert found["ball_apex_bias_deconvolved_filtered"].predicted == pytest.approx(expected, rel=1e-3)
    assert rows(setup(), measured(true_points()))["ball_apex_bias"].predicted is None


def test_a_ball_that_was_not_found_is_left_out_and_leaves_coplanarity_unknown(setup):
    xyz = true_points()
    grid = BallGridAsMounted.of(setup().bench)
    xyz[(grid.nearest_ball(grid.in_part(xyz)) == 4) & (slopes_deg() < 90)] = np.nan
    found = rows(setup(), measured(xyz, DECONVOLVED))
    assert found["ball_apex_bias_deconvolved"].n == 8
    for name in ("coplanarity_error_deconvolved", "coplanarity_regression_error_deconvolved"):
        assert np.isnan(found[name].measured)
        assert (found[name].n, found[name].holds, found[name].expected_to_hold) == (8, False, True)
    assert found["cap15_valid_share_deconvolved"].measured == pytest.approx(8 / 9, abs=0.03)


@pytest.mark.slow
@pytest.mark.parametrize("treatment", [DECONVOLVED, DECONVOLVED_FILTERED])
def test_where_nothing_is_measured_all_rows_are_there_and_those_with_limits_fail(setup, treatment):
    xyz = true_points()
    good = rows(setup(), measured(xyz, treatment))
    found = rows(setup(), measured(np.full(xyz.shape, np.nan), treatment))
    assert found.keys() == good.keys()
    for name, row in found.items():
        assert row.limit == good[name].limit
        assert row.holds is (None if row.limit is None else False), row
        assert row.expected_to_hold is (None if row.limit is None else True), row
        if "valid_share" in name:
            assert row.measured == 0.0
        else:
            assert np.isnan(row.measured)


@pytest.mark.slow
def test_points_beside_their_ball_are_infinitely_wrong(setup):
    """Every tenth point of the caps lies between the balls: a spread that 95 % keep to is not one of the others."""
    xyz = true_points()
    cap = np.argwhere(slopes_deg() <= 15)[::10]
    xyz[tuple(cap.T)] += [0.4, 0.4, 0.0]  # half a pitch
    found = rows(setup(), measured(xyz, DECONVOLVED_FILTERED))
    p95, bias = (found[f"cap15_{name}_deconvolved_filtered"] for name in ("p95", "bias"))
    assert p95.measured == np.inf
    assert p95.holds is False
    assert p95.n - bias.n == len(cap)
    assert bias.measured == pytest.approx(0, abs=1e-6)
    assert f"without {len(cap)} points beside" in bias.criterion
    few = true_points()
    few[tuple(cap[::4].T)] += [0.4, 0.4, 0.0]  # one in forty
    assert rows(setup(), measured(few, DECONVOLVED_FILTERED))["cap15_p95_deconvolved_filtered"].holds is True


@pytest.mark.slow
def test_a_bowl_has_no_apex(setup):
    """The caps turned upside down about their apexes' heights."""
    xyz = true_points()
    grid = BallGridAsMounted.of(setup().bench)
    apex = grid.apexes[grid.nearest_ball(grid.in_part(xyz)), 2] + SHIFT[2, 3]
    xyz[..., 2] = np.where(slopes_deg() <= 45, 2 * apex - xyz[..., 2], xyz[..., 2])
    assert np.isnan(rows(setup(), measured(xyz))["ball_apex_bias"].measured)
