import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from greenough.instrument.errors import InputError
from greenough.pipeline import phase_height
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


@settings(max_examples=30)
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


def lstsq_heights(phase, z, t):
    """Heights at normalised phases t of one pixel, in float64: eq. 19, then two Gauss-Newton steps of eq. 18.

    By orthogonal factors of the equations themselves; normal equations would square their condition.
    """
    seen = np.isfinite(phase)
    phase, z = phase[seen].astype(float), z[seen]
    # Float32 like the stored numbers: another normalisation is another start.
    centre, half_range = (np.float32(f(phase.max(), phase.min()) / 2) for f in (np.add, np.subtract))
    at = (phase - centre) / half_range
    m1, m0, n1 = np.linalg.lstsq(np.stack([at, np.ones_like(at), -at * z], axis=-1), z, rcond=None)[0]
    r3 = 0.0
    for _ in range(2):
        w = (m1 * at + m0) / (n1 * at + 1)
        by_w = (1 + 3 * r3 * w**2) / (n1 * at + 1)
        jacobian = np.stack([by_w * at, by_w, -by_w * at * w, w**3], axis=-1)
        lengths = np.linalg.norm(jacobian, axis=0)
        step = np.linalg.lstsq(jacobian / lengths, z - w - r3 * w**3, rcond=None)[0] / lengths
        m1, m0, n1, r3 = np.array([m1, m0, n1, r3]) + step
    w = (m1 * t + m0) / (n1 * t + 1)
    return w + r3 * w**3


def departures(relation, phases, z):
    """Heights of a relation less those of `lstsq_heights`, at phases from a tenth below to a tenth above the range."""
    t = np.linspace(-1.1, 1.1, 12)
    at = relation.phase_centre + t[:, None, None] * relation.phase_half_range.astype(float)
    found = np.stack([relation.height(phase) for phase in at])
    pixels = list(np.ndindex(relation.shape))
    expected = np.stack([lstsq_heights(phases[:, row, col], z, t) for row, col in pixels], axis=-1)
    return found - expected.reshape(found.shape)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize(
    ("first", "last"), [(0, 30), (0, 8), (22, 30), (0, 12), (18, 30), (0, 20), (10, 30), (0, 25), (11, 19)]
)
def test_every_pixel_is_fitted_as_in_double_precision(first, last, dtype):
    """To a fifth of 0.01 µm, a little beyond the ends too, with planes missing in between, at one end or at both."""
    rng = np.random.default_rng(first)
    noise = 0.0104 if last - first > 8 else 0.001  # with the noise of a single pixel eight planes leave r3 open
    phases = planes(shape=(5, 6), stride=200) + rng.normal(0, noise, (30, 5, 6))
    phases[:first], phases[last:] = np.nan, np.nan
    if last - first > 20:
        phases[rng.random(phases.shape) < 0.1] = np.nan
    phases = phases.astype(dtype)
    relation = fit_phase_height(phases, HEIGHTS).relation
    assert relation.valid.all()
    assert np.abs(departures(relation, phases, HEIGHTS)).max() < 0.002e-3


def test_more_planes_than_one_kernel_takes_are_fitted_alike():
    heights = np.linspace(-1.45, 1.45, 75)
    rng = np.random.default_rng(2)
    phases = (planes(heights, shape=(4, 6)) + rng.normal(0, 0.0104, (75, 4, 6))).astype(np.float32)
    fit = fit_phase_height(phases, heights)
    relation = fit.relation
    assert np.abs(departures(relation, phases, heights)).max() < 0.002e-3
    errors = np.array([relation.height(phase) - z for phase, z in zip(phases, heights, strict=True)])
    np.testing.assert_allclose(fit.plane_residual_um, 1e3 * errors.mean(axis=(1, 2)), atol=1e-3)
    np.testing.assert_allclose(fit.residual_um, 1e3 * np.sqrt(np.mean(errors**2, axis=0)), atol=1e-3)


class AskedFor:
    """Phases that note how many of them are asked for at once, as a file would be read."""

    def __init__(self, phases):
        self.phases, self.shape, self.most = phases, phases.shape, 0

    def __getitem__(self, index):
        part = self.phases[index]
        self.most = max(self.most, part.size)
        return part


def test_strips_of_the_picture_make_no_difference_and_bound_what_is_read(monkeypatch):
    rng = np.random.default_rng(6)
    phases = (planes(shape=(23, 16)) + rng.normal(0, 0.0104, (30, 23, 16))).astype(np.float32)
    phases[8:, 3, 2:9], phases[20, 7, 7] = np.nan, 0.0
    whole = fit_phase_height(phases, HEIGHTS)
    for limit in (30 * 16 * 5 + 7, 1):
        monkeypatch.setattr(phase_height, "STRIP_PHASES", limit)
        asked = AskedFor(phases)
        parts = fit_phase_height(asked, HEIGHTS)
        assert asked.most <= max(limit, 30 * 16)
        for name in ("coefficients", "phase_centre", "phase_half_range", "z_range", "valid"):
            one, other = (getattr(fit.relation, name) for fit in (whole, parts))
            np.testing.assert_array_equal(one, other)
        np.testing.assert_allclose(parts.plane_residual_um, whole.plane_residual_um, atol=1e-4)
        assert parts.condition == whole.condition


def test_a_relation_known_in_fewer_pixels_is_the_same_there():
    phases = planes()
    phases[MIN_PLANES - 1 :, 0, 0] = np.nan
    relation = fit_phase_height(phases, HEIGHTS).relation
    chosen = np.random.default_rng(8).random(relation.shape) < 0.5
    chosen[0, 0] = True
    fewer = relation.where(chosen)
    assert np.array_equal(fewer.valid, chosen & relation.valid)
    assert not fewer.valid[0, 0]
    for name in ("coefficients", "phase_centre", "phase_half_range", "z_range"):
        one, other = (getattr(each, name) for each in (relation, fewer))
        assert other.dtype == np.float32
        assert np.array_equal(one[fewer.valid], other[fewer.valid])
        assert np.isnan(other[~fewer.valid]).all()


def test_a_field_over_which_sensitivity_varies_by_a_quarter_is_calibrated_to_its_corners():
    wide = {"distance": 400.0, "angle_deg": 11.0, "focal": 800.0, "stride": 30}
    heights = 20 * HEIGHTS
    phases = planes(heights, **wide)
    rate = phases[-1] - phases[0]
    assert rate.max() / rate.min() > 1.24  # the middle is further from either end than what is tolerated
    phases[:, 5, 7] = phases[:1, 5, 7] + 1.2 * (phases[:, 5, 7] - phases[:1, 5, 7])  # as a wall that passes by
    valid = fit_phase_height(phases, heights).relation.valid
    assert not valid[5, 7]
    assert valid.sum() == valid.size - 1
