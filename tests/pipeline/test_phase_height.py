import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from greenough.instrument.errors import InputError
from greenough.pipeline.phase_height import MIN_PLANES, fit_phase_height

HEIGHTS = (np.arange(30) - 14.5) * 0.1


def column_phase(z, shape=(12, 16), distance=224.56, angle_deg=6.0, focal=22683.0, stride=80):
    """Absolute phase in rad that two converging pinholes give a plane at height z, (rows, cols): plain ray geometry.

    Camera centre at +angle_deg, projector centre at -angle_deg in the x-z plane, both aimed at the origin. ``stride``
    spreads a few pixels over the whole 1280 x 960 picture.
    """
    rows, cols = shape
    v, u = (np.mgrid[:rows, :cols] - np.array([rows - 1, cols - 1]).reshape(2, 1, 1) / 2) * stride
    sine, cosine = np.sin(np.radians(angle_deg)), np.cos(np.radians(angle_deg))
    camera = distance * np.array([sine, 0.0, cosine])
    projector = distance * np.array([-sine, 0.0, cosine])
    direction = np.stack([u / focal * cosine - sine, -v / focal * np.ones_like(u), -u / focal * sine - cosine], axis=-1)
    point = camera + direction * ((z - camera[2]) / direction[..., 2])[..., None]
    ray = point - projector
    x = ray @ np.array([cosine, 0.0, sine])
    depth = -(ray @ projector) / distance
    column = 303.5 + 608 * distance / 10.84 * x / depth
    return 2 * np.pi * column / 12


def planes(heights=HEIGHTS, **geometry):
    return np.stack([column_phase(z, **geometry) for z in heights])


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_two_pinholes_are_followed_to_a_hundredth_of_a_micrometre(dtype):
    fit = fit_phase_height(planes().astype(dtype), HEIGHTS)
    for z in np.linspace(-1.45, 1.45, 21):
        height = fit.relation.height(column_phase(z).astype(dtype))
        assert np.abs(height - z).max() < 0.01e-3


def test_the_cubic_term_carries_what_two_pinholes_lack():
    bend = 1e-4  # mm of height per mm³: a distortion along the ray that no Möbius function has
    true = HEIGHTS + bend * HEIGHTS**3
    fit = fit_phase_height(planes(), true)
    z = 0.77
    height = fit.relation.height(column_phase(z))
    assert np.abs(height - (z + bend * z**3)).max() < 0.01e-3


def test_the_gauge_leaves_a_well_conditioned_fit():
    assert fit_phase_height(planes(), HEIGHTS).condition < 20


def test_gauss_newton_has_reached_the_minimum_of_the_height_residuals():
    rng = np.random.default_rng(5)
    phases = planes(shape=(2, 3)) + rng.normal(0, 0.0104, (30, 2, 3))
    fit = fit_phase_height(phases, HEIGHTS)
    relation = fit.relation
    for row, col in np.ndindex(2, 3):
        t = (phases[:, row, col] - relation.phase_centre[row, col]) / relation.phase_half_range[row, col]

        def cost(coefficients, t=t):
            m1, m0, n1, r3 = coefficients
            w = (m1 * t + m0) / (n1 * t + 1)
            return np.sum((w + r3 * w**3 - HEIGHTS) ** 2)

        best = relation.coefficients[row, col].astype(float)
        for i in range(4):
            for step in (-1e-4, 1e-4):
                moved = best.copy()
                moved[i] += step
                assert cost(moved) > cost(best)


def test_noise_in_the_fit_has_the_predicted_size():
    # Linear theory: the RMS over the planes of the calibration's own error is sqrt(4/30) of one measurement's sd.
    sigma = 0.0104
    clean = planes(shape=(48, 64), stride=20)
    rng = np.random.default_rng(11)
    fit = fit_phase_height(clean + rng.normal(0, sigma, clean.shape), HEIGHTS)
    slope = (HEIGHTS[-1] - HEIGHTS[0]) / (clean[-1] - clean[0])  # mm per rad
    errors = np.stack([fit.relation.height(phase) - z for phase, z in zip(clean, HEIGHTS, strict=True)])
    ratio = np.sqrt(np.mean((errors / (sigma * slope)) ** 2))
    # 4 x 3072 independent degrees of freedom: the ratio's own sd is 0.64 %, five of them a false alarm in 2e6.
    assert ratio == pytest.approx(np.sqrt(4 / 30), rel=0.035)
    # What the planes miss the relation by is the rest of the noise.
    residual = np.sqrt(np.nanmean(fit.residual_um**2))
    assert residual == pytest.approx(1e3 * sigma * np.abs(slope).mean() * np.sqrt(26 / 30), rel=0.03)


def test_a_stage_error_common_to_all_pixels_shows_in_the_plane_residuals():
    stated = HEIGHTS.copy()
    stated[13] += 0.005
    fit = fit_phase_height(planes(), stated)
    assert np.argmax(np.abs(fit.plane_residual_um)) == 13
    assert -5.0 < fit.plane_residual_um[13] < -4.0  # the fit takes up about 4/30 of it


def test_a_pixel_seen_in_a_part_of_the_planes_states_its_own_range():
    phases = planes()
    phases[:10, 3, 4] = np.nan
    phases[25:, 3, 4] = np.nan
    relation = fit_phase_height(phases, HEIGHTS).relation
    assert relation.z_range[3, 4] == pytest.approx([HEIGHTS[10], HEIGHTS[24]], abs=1e-6)
    assert relation.z_range[3, 5] == pytest.approx([HEIGHTS[0], HEIGHTS[-1]], abs=1e-6)
    assert abs(relation.height(column_phase(0.2))[3, 4] - 0.2) < 0.01e-3


def test_a_pixel_in_too_few_planes_is_not_calibrated():
    phases = planes()
    phases[MIN_PLANES - 1 :, 0, 0] = np.nan
    phases[MIN_PLANES:, 0, 1] = np.nan
    relation = fit_phase_height(phases, HEIGHTS).relation
    assert not relation.valid[0, 0]
    assert np.isnan(relation.height(column_phase(0.0))[0, 0])
    assert relation.valid[0, 1]


@settings(max_examples=30, deadline=None)
@given(plane=st.integers(0, 29), order=st.sampled_from([-2, -1, 1, 2]))
def test_one_wrong_fringe_order_costs_the_pixel_and_no_other(plane, order):
    phases = planes(shape=(3, 4), stride=300)
    phases[plane, 1, 2] += 2 * np.pi * order
    relation = fit_phase_height(phases, HEIGHTS).relation
    assert not relation.valid[1, 2]
    assert relation.valid.sum() == relation.valid.size - 1


def test_a_pixel_whose_phase_changes_otherwise_than_its_neighbours_is_not_calibrated():
    # The ray of such a pixel ends on a wall that passes by: the phase follows at another rate, however smoothly.
    phases = planes()
    phases[:, 2, 3] = phases[0, 2, 3] + 0.4 * (phases[:, 2, 3] - phases[0, 2, 3])
    relation = fit_phase_height(phases, HEIGHTS).relation
    assert not relation.valid[2, 3]
    assert np.isnan(relation.coefficients[2, 3]).all()
    assert relation.valid.sum() == relation.valid.size - 1


def test_a_plane_that_misses_the_relation_costs_the_pixel():
    phases = planes()
    phases[20, 2, 3] += 0.5
    phases[20, 4, 5] += 0.1
    relation = fit_phase_height(phases, HEIGHTS).relation
    assert not relation.valid[2, 3]
    assert relation.valid.sum() == relation.valid.size - 1


def test_too_few_heights_are_refused():
    with pytest.raises(InputError, match="8 or more different heights, got 5"):
        fit_phase_height(planes(HEIGHTS[:5]), HEIGHTS[:5])


def test_planes_without_a_valid_pixel_are_refused():
    with pytest.raises(InputError, match="no pixel"):
        fit_phase_height(np.full((30, 4, 5), np.nan), HEIGHTS)


def test_phase_is_the_inverse_of_height():
    bent = HEIGHTS + 3e-4 * HEIGHTS**3
    relation = fit_phase_height(planes(), bent).relation
    z = np.random.default_rng(3).uniform(-1.5, 1.5, (12, 16))
    np.testing.assert_allclose(relation.height(relation.phase(z)), z, atol=1e-9)


def test_a_relation_within_other_heights_is_the_same_relation():
    bent = HEIGHTS + 3e-4 * HEIGHTS**3
    relation = fit_phase_height(planes(), bent).relation
    rng = np.random.default_rng(4)
    low, high = rng.uniform(-1.4, -0.5, (12, 16)), rng.uniform(0.2, 1.4, (12, 16))
    valid = rng.random((12, 16)) < 0.8
    part = relation.within(np.stack([low, high], axis=-1), valid)
    phase = relation.phase(rng.uniform(-1.4, 1.4, (12, 16)))
    np.testing.assert_allclose(part.height(phase)[valid], relation.height(phase)[valid], atol=1e-6)
    assert np.isnan(part.height(phase)[~valid]).all()
    for z, inside in ((low - 0.04, True), (low - 0.06, False), (high + 0.04, True), (high + 0.06, False)):
        assert (part.covers(relation.phase(z), margin_mm=0.05)[valid] == inside).all()


def test_a_pixel_that_was_not_valid_does_not_become_so():
    phases = planes()
    phases[MIN_PLANES - 1 :, 0, 0] = np.nan
    relation = fit_phase_height(phases, HEIGHTS).relation
    part = relation.within(np.broadcast_to([-1.0, 1.0], (12, 16, 2)), np.ones((12, 16), dtype=bool))
    assert not part.valid[0, 0]
    assert part.valid.sum() == part.valid.size - 1
