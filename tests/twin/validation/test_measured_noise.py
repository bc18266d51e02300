"""Measured over stated noise, on pairs of maps whose noise is known."""

from types import SimpleNamespace

import numpy as np
import pytest

from greenough.instrument.contract import CameraNoise
from greenough.instrument.errors import InputError
from greenough.pipeline.decode import decode
from greenough.pipeline.fringes import PAPER
from greenough.twin.settings import StabilitySettings, TwinSettings
from greenough.twin.validation.measured import FILTERED, RAW
from greenough.twin.validation.measured_noise import RATIO_TOLERANCE, Repeated, bound_row, noise_ratio, ratio_rows

SHAPE = (200, 300)
STEADY = TwinSettings(stability=StabilitySettings(flicker=0.0, vibration_um=0.0))


def repeated(seed: int = 1, excess: float | np.ndarray = 1.0, treatment: str = RAW, shift: float = 0.01) -> Repeated:
    """A relief measured twice, with ``excess`` times the noise that is stated; dark to the left, steep at the top."""
    rng = np.random.default_rng(seed)
    modulation = np.broadcast_to(np.linspace(5, 80, SHAPE[1]), SHAPE)
    sigma = 0.08 / modulation
    surface = np.sin(np.arange(SHAPE[0]) / 9)[:, None] * 0.3 * np.ones(SHAPE[1])
    first, second = (surface + excess * sigma * rng.standard_normal(SHAPE) for _ in range(2))
    first[:5], second[:, -7:] = np.nan, np.nan
    slope_deg = np.broadcast_to(np.linspace(60, 0, SHAPE[0])[:, None], SHAPE)
    inside = np.ones(SHAPE, bool)
    if treatment == FILTERED:
        inside[:, 200:] = False
    return Repeated("coin", treatment, first, second + shift, sigma, modulation, slope_deg, inside)


def rows(setup, of: Repeated) -> dict:
    return {row.claim: row for row in ratio_rows(setup, of)}


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_noise_that_is_stated_rightly_has_the_ratio_one_within_its_own_spread(seed):
    """Five standard deviations: 1 in a million."""
    found = noise_ratio(repeated(seed), np.ones(SHAPE, bool))
    assert found.n == (SHAPE[0] - 5) * (SHAPE[1] - 7)
    assert abs(found.ratio - 1) < 5 * found.sd
    assert 1 / np.sqrt(2 * found.n) < found.sd < 0.02


@pytest.mark.slow
def test_rows_hold_for_right_noise_and_not_for_wrong_noise(analytic):
    for excess, holds in ((1.0, True), (1.1, False), (0.9, False)):
        row = rows(analytic(settings=STEADY), repeated(excess=excess))["noise_ratio"]
        assert row.measured == pytest.approx(excess, rel=0.035)
        assert (row.holds, row.expected_to_hold, row.limit) == (holds, True, RATIO_TOLERANCE)


def test_with_flicker_or_vibration_rows_only_report(analytic):
    assert {row.limit for row in ratio_rows(analytic(), repeated(excess=1.2))} == {None}


def test_errors_that_compensate_show_in_the_classes(analytic):
    """Dark pixels, which make most of the noise, state too much, and bright ones too little."""
    excess = np.where(np.arange(SHAPE[1]) < 60, 0.94, 1.22)
    found = rows(analytic(settings=STEADY), repeated(excess=excess))
    assert found["noise_ratio"].holds
    assert found["noise_ratio_modulation_1"].measured == pytest.approx(0.94, rel=0.035)
    assert found["noise_ratio_modulation_5"].measured == pytest.approx(1.22, rel=0.035)


def test_slopes_have_rows_of_their_own(analytic):
    steep = np.where(np.linspace(60, 0, SHAPE[0])[:, None] >= 45, 1.5, 1.0)
    found = rows(analytic(settings=STEADY), repeated(excess=steep))
    assert found["noise_ratio_slope_45_90deg"].measured == pytest.approx(1.5, rel=0.045)
    assert found["noise_ratio_slope_0_10deg"].measured == pytest.approx(1.0, rel=0.045)


def test_filtered_maps_are_judged_where_the_filters_reach_is_measured_and_reported_everywhere(analytic):
    beyond = np.where(np.arange(SHAPE[1]) < 200, 1.0, 2.0)
    found = rows(analytic(settings=STEADY), repeated(excess=beyond, treatment=FILTERED))
    assert found["noise_ratio_filtered"].holds
    assert found["noise_ratio_filtered"].n == (SHAPE[0] - 5) * 200
    everywhere = found["noise_ratio_everywhere_filtered"]
    assert everywhere.measured > 1.02
    assert everywhere.limit is None
    assert {row.filter for row in found.values()} != {"none"}


@pytest.mark.parametrize(("added_dn", "holds"), [(0.0, True), (0.7, False)])
def test_the_phase_of_simulated_frames_is_at_its_bound_unless_they_have_more_noise(analytic, added_dn, holds):
    """40 000 pixels: their variance is known to 0.7 %."""
    rng, shape = np.random.default_rng(4), (200, 200)
    camera = CameraNoise(6500.0, 10.0, 6500 / 251)
    column = np.linspace(100, 500, shape[0] * shape[1]).reshape(shape)
    angle = [
        2 * np.pi * (column / p + n / k) for p, k in zip(PAPER.periods, PAPER.steps, strict=True) for n in range(k)
    ]
    electrons = camera.electrons_per_dn * (97 + 75 * np.cos(np.array(angle)))
    maps = []
    for _ in range(2):
        more = rng.normal(0, np.hypot(10.0, added_dn * camera.electrons_per_dn), electrons.shape)
        grey = np.rint((rng.poisson(electrons) + more) / camera.electrons_per_dn)
        maps.append(decode(np.clip(grey, 0, 255).astype(np.uint8), PAPER, camera))
    setup = analytic(settings=STEADY)
    setup.rig.camera = SimpleNamespace(noise=camera)
    found = bound_row(setup, "plane", maps)
    assert found.n == maps[0].valid.sum() > 39_000
    assert (found.holds, found.expected_to_hold) == (holds, True)
    # The variance of a grey value is 3.98 DN² in the mean; the weights make more of noise that is alike in all frames.
    least = 1 + added_dn**2 / 3.98
    assert 0.97 * least < found.measured < 1.08 * least


def test_few_pixels_are_refused():
    with pytest.raises(InputError, match="100"):
        noise_ratio(repeated(), np.zeros(SHAPE, bool))
