"""Claims about the test for white noise: its false alarms on noise, and what it finds in it."""

from collections.abc import Sequence

import numpy as np
import pytest

from greenough.instrument.contract import Placement
from greenough.pipeline.acquisition import plane_phase
from greenough.pipeline.decode import PhaseMap, decode
from greenough.pipeline.exposure import auto_exposure
from greenough.pipeline.fringes import FringeSet
from greenough.pipeline.phase_height import PhaseHeight, fit_phase_height
from greenough.twin.rig import open as open_twin
from greenough.twin.validation.whiteness import LAGS, SCALES_PX, Whiteness, detectable, whiteness

SHAPE = (240, 320)
FALSE_ALARMS = 0.01


def noise(rng: np.random.Generator, sigma: np.ndarray | float = 1.0) -> np.ndarray:
    """White, with a border that is not measured and some pixels missing."""
    values = sigma * rng.standard_normal(SHAPE)
    values[:5] = values[:, -7:] = np.nan
    values[rng.random(SHAPE) < 0.02] = np.nan
    return values


def block_structure(rng: np.random.Generator, rms: float, side: int) -> np.ndarray:
    """Random heights of squares of twice ``side``, so that half of the blocks of ``side`` are like their neighbour."""
    coarse = rng.standard_normal((SHAPE[0] // (2 * side) + 1, SHAPE[1] // (2 * side) + 1))
    fine = np.repeat(np.repeat(coarse, 2 * side, axis=0), 2 * side, axis=1)[: SHAPE[0], : SHAPE[1]]
    return rms * fine / np.sqrt(np.mean(fine**2))


@pytest.fixture(scope="module")
def of_noise() -> list[Whiteness]:
    """What the test says of 100 maps whose noise quadruples over the picture."""
    rng = np.random.default_rng(1)
    sigma = np.linspace(0.5, 2.0, SHAPE[1]) * np.ones((SHAPE[0], 1))
    return [whiteness(noise(rng, sigma), sigma) for _ in range(100)]


def test_false_alarms_are_as_rare_as_stated(of_noise):
    """100 maps at a p-value of 0.05 give 5 alarms; 15 or more come once in 7000 runs. The p-value bounds the
    probability from above, so that there may be fewer."""
    assert sum(found.p_value < 0.05 for found in of_noise) <= 14


def test_scores_are_standard_normal_under_noise(of_noise):
    """The variance of 100 scores is known to √(2 / 99) = 14 %, their mean to 0.1: 5 of these for any of 24 scores."""
    scores = np.array([found.scores for found in of_noise])
    assert scores.shape[1:] == (len(SCALES_PX), len(LAGS))
    assert np.isnan(scores[:, -1]).all()  # 7 x 9 blocks of 32 px
    scores = scores[:, :-1]
    np.testing.assert_allclose(scores.var(axis=0, ddof=1), 1, atol=0.71)
    np.testing.assert_allclose(scores.mean(axis=0), 0, atol=0.5)


@pytest.mark.parametrize("side", [1, 4, 16])
def test_structure_above_what_is_said_to_be_detectable_is_found_and_far_below_it_is_not(side):
    """Twice the detectable RMS has 4 times its score over half of the pairs: twice the score that raises an alarm. A
    third has a ninth of it."""
    rng = np.random.default_rng(3)
    size = detectable(1.0, SHAPE[0] * SHAPE[1], side, FALSE_ALARMS)
    found = [whiteness(noise(rng) + block_structure(rng, 2 * size, side), np.ones(SHAPE)).p_value for _ in range(10)]
    assert np.mean(np.array(found) < FALSE_ALARMS) > 0.6
    missed = [whiteness(noise(rng) + block_structure(rng, size / 3, side), np.ones(SHAPE)).p_value for _ in range(10)]
    assert np.mean(np.array(missed) < FALSE_ALARMS) < 0.4


@pytest.mark.parametrize("measured", [0, 50])
def test_a_map_with_too_few_pairs_is_refused(measured):
    residual = np.full(SHAPE, np.nan)
    residual[0, :measured] = np.random.default_rng(5).standard_normal(measured)
    with pytest.raises(ValueError, match="fewer than 100 pairs"):
        whiteness(residual, np.ones(SHAPE))


def test_neighbours_that_share_noise_are_found():
    rng = np.random.default_rng(4)
    white = noise(rng)
    filtered = white[:, 1:] + 0.05 * white[:, :-1]
    assert whiteness(filtered, np.ones(filtered.shape)).p_value < 1e-6
    assert whiteness(filtered, np.ones(filtered.shape)).correlations[0, 0] == pytest.approx(0.05, abs=0.02)


# A whole field in pixels of 40 um without anything that two exposures of a plane do not share but the camera's noise.
QUIET = (
    "twin.optics.glass=false", "camera.rows=240", "camera.cols=320", "twin.optics.camera_focal_px=5670.75",
    "procedure.planes=10", "procedure.plane_step_mm=0.3", "twin.stability.flicker=0", "twin.stability.vibration_um=0",
    "twin.stability.table_drift_um=0", "twin.stability.path_drift_um=0", "twin.stage.position_sd_um=0",
    "twin.stage.straightness_sd_um=0", "twin.stage.pitch_roll_sd_urad=0", "twin.stage.axis_sd_deg=0",
)  # fmt: skip
NOISELESS = ("camera.bits=0", "twin.camera.shot_noise=false", "twin.camera.read_noise_e=0")


def captured(overrides: Sequence[str], heights: Sequence[float]) -> list[PhaseMap]:
    rig, _ = open_twin("twin", overrides, run="whiteness")
    fringes = FringeSet(rig.procedure.periods_px, rig.procedure.steps)
    phase_maps = []
    with rig:
        rig.operator.place(Placement("plane"))
        auto_exposure(rig)
        for height in heights:
            rig.stage.move_to_mm(height)
            phase_maps.append(decode(rig.capture(fringes.patterns(*rig.projector.shape)), fringes, rig.camera.noise))
    return phase_maps


@pytest.fixture(scope="module")
def relation() -> PhaseHeight:
    """Of every pixel, from planes without noise."""
    heights = np.linspace(-1.35, 1.35, 10)
    phase_maps = captured([*QUIET, *NOISELESS], heights)
    return fit_phase_height(np.stack([plane_phase(phase_map) for phase_map in phase_maps]), heights).relation


@pytest.mark.parametrize(("change", "white"), [((), True), (("twin.stability.flicker=0.01",), False)])
def test_a_rendered_plane_is_white_without_flicker_and_not_with_it(relation, change, white):
    """The camera's noise alone is called structure once in 1000 seeds. Flicker of 1 % ripples at the fringes' period by
    √(2/12) * 1 % * 163 um/rad = 0.7 um, here 5 px long, which is found at any seed."""
    (phase_map,) = captured([*QUIET, *change], [0.1])
    residual = relation.height(phase_map.absolute) - 0.1
    sigma = phase_map.sigma * np.abs(relation.height(phase_map.absolute + 1e-3) - relation.height(phase_map.absolute))
    assert np.isfinite(residual).sum() > 20_000
    assert (whiteness(residual, sigma).p_value > 1e-3) is white
