"""Blur times brightness on rendered metal, taken out with a point spread that the pipeline estimated from the board."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

import greenough.twin as gt
from greenough.instrument.contract import Placement
from greenough.pipeline.camera_calibration import calibrate_camera
from greenough.pipeline.decode import PhaseMap, decode
from greenough.pipeline.deconvolution import deconvolve_phasors
from greenough.pipeline.exposure import auto_exposure, capture_bracketed
from greenough.pipeline.fringes import FringeSet
from greenough.pipeline.phase_height import PhaseHeight, fit_phase_height
from greenough.pipeline.point_spread import PointSpread, estimate_point_spread
from greenough.pipeline.spots import detect_spots
from greenough.twin.validation.evaluation import smooth

AIRY_RADIUS_PX = 2.16
RIM_PX = 8  # of a cropped picture: what lies outside it is blurred into it, and unlike a whole picture's rim it is lit
CROP = ("camera.rows=180", "camera.cols=240")  # 2.4 x 1.8 mm in the middle, in the pixels of the full camera
PERFECT_STAGE = ("position_sd_um", "straightness_sd_um", "pitch_roll_sd_urad", "axis_sd_deg")
PERFECT = ("twin.optics.glass=false", *(f"twin.stage.{name}=0" for name in PERFECT_STAGE))
POSTURES = (0, 2, 4, 6, 7, None)  # as few as calibrate the camera


@lru_cache
def point_spread() -> PointSpread:
    """From whole pictures of the board alone, as a calibration has them: a crop shows too little of its depth."""
    rig, _ = gt.open("twin", [*PERFECT, "twin.render.nodes=16"])
    spots = []
    white = np.full((1, *rig.projector.shape), 255, np.uint8)
    for posture in POSTURES:
        rig.operator.place(Placement("board", posture=posture))
        spots.append(detect_spots(rig.irradiance(white)[0], rig.board))
    camera = calibrate_camera(spots, rig.board, rig.camera.shape, len(spots) - 1)
    return estimate_point_spread(spots, camera, rig.board)


@lru_cache
def calibrated() -> tuple[gt.TwinRig, gt.Bench, PhaseHeight]:
    """A perfect instrument with a small picture, whose relation of phase and height is known from nine planes."""
    rig, bench = gt.open("twin", [*CROP, *PERFECT, "twin.board.ink_thickness_um=0", "twin.render.bounces=1"])
    rig.operator.place(Placement("plane"))
    heights = np.linspace(-0.4, 0.4, 9)
    phases = []
    for height in heights:
        rig.stage.move_to_mm(height)
        phases.append(without_noise(rig).absolute)
    rig.stage.move_to_mm(0.0)
    return rig, bench, fit_phase_height(np.stack(phases), heights).relation


def fringes(rig: gt.TwinRig) -> FringeSet:
    return FringeSet(rig.procedure.periods_px, rig.procedure.steps)


def without_noise(rig: gt.TwinRig) -> PhaseMap:
    stack = rig.irradiance(fringes(rig).patterns(*rig.projector.shape))
    return decode(stack / stack.max(), fringes(rig))


def with_noise(rig: gt.TwinRig) -> PhaseMap:
    """By the camera as it is, several exposures merged as `greenough measure --bracket` does."""
    auto_exposure(rig)
    shortest, longest = (limit / rig.camera.exposure_us for limit in rig.camera.exposure_limits_us)
    ratios = [ratio for ratio in rig.procedure.brackets if shortest <= ratio <= longest]
    merged = capture_bracketed(rig, fringes(rig).patterns(*rig.projector.shape), ratios)
    return decode(merged.frames, fringes(rig), merged.variance)


@lru_cache
def judged(sample: str) -> tuple[PhaseMap, PhaseMap, np.ndarray, np.ndarray, np.ndarray]:
    """Of one sample: phase maps without and with noise, true height (mm), true slope (°), and where it is judged."""
    rig, bench, _ = calibrated()
    rig.operator.place(Placement(sample))
    clean, noisy = without_noise(rig), with_noise(rig)
    truth = bench.truth()
    where = smooth(truth, AIRY_RADIUS_PX) & clean.valid & noisy.valid
    rim = np.ones_like(where)
    rim[RIM_PX:-RIM_PX, RIM_PX:-RIM_PX] = False
    slope = np.degrees(np.arccos(np.clip(truth.normal[..., 2], -1, 1)))
    return clean, noisy, truth.xyz_world[..., 2], slope, where & ~rim


def heights(phase_map: PhaseMap) -> np.ndarray:
    relation = calibrated()[2]
    return relation.height(np.where(phase_map.valid, phase_map.absolute, np.nan))


def deconvolved(phase_map: PhaseMap) -> PhaseMap:
    lens = replace(point_spread(), shape=phase_map.valid.shape)  # the crop has the same middle
    return deconvolve_phasors(phase_map, lens, heights(phase_map))


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


@pytest.mark.slow
def test_the_lens_is_found_from_the_board():
    """2 NA / wavelength and NA, both at the specimen, in pixels of 9.9 um; the axis is 6° off the world's z."""
    optics = gt.open("twin")[1].settings.optics
    pixel = optics.pupil_distance_mm / optics.camera_focal_px
    found = point_spread()
    assert found.cutoff_per_px == pytest.approx(2 * optics.na / (optics.wavelength_um * 1e-3) * pixel, rel=0.04)
    tilt = np.radians(optics.convergence_deg / 2)
    assert found.defocus_px_per_mm == pytest.approx(optics.na / pixel * np.cos(tilt), rel=0.04)
    assert abs(found.focus_mm[1]) == pytest.approx(np.tan(tilt) * pixel, rel=0.1)


@pytest.mark.slow
@pytest.mark.parametrize("sample", ["coin", "bga"])
def test_metal_without_noise_is_right_within_a_micrometre(sample):
    clean, _, truth, _, where = judged(sample)
    before, after = (1e3 * (heights(each) - truth)[where] for each in (clean, deconvolved(clean)))
    assert rms(before) > 5.0
    assert rms(after) < 1.0
    assert abs(after.mean()) < 0.2


@pytest.mark.parametrize(("slopes", "limit_um"), [((5, 15), 0.6), ((15, 30), 1.0), ((30, 45), 1.5)])
def test_walls_of_solder_balls(slopes, limit_um):
    clean, _, truth, slope, where = judged("bga")
    wall = where & (slope >= slopes[0]) & (slope < slopes[1])
    assert wall.sum() > 300
    assert rms(1e3 * (heights(clean) - truth)[wall]) > 10.0
    assert rms(1e3 * (heights(deconvolved(clean)) - truth)[wall]) < limit_um


@pytest.mark.parametrize("sample", ["coin", "bga"])
def test_with_the_cameras_noise_little_but_noise_is_left(sample):
    """What noise does alone is known from the map without it; deconvolution must add next to nothing to that."""
    clean, noisy, truth, _, where = judged(sample)
    freed = deconvolved(noisy)
    noise = rms((heights(noisy) - heights(clean))[where])
    assert rms((heights(freed) - truth)[where]) < 1.06 * noise
    assert rms((heights(noisy) - truth)[where]) > 1.5 * noise


def test_the_coin_is_within_twice_its_stated_noise():
    """95 % of a normal distribution lie within 1.96 sigma; fixed patterns of the pixels are not in sigma."""
    _, noisy, truth, _, where = judged("coin")
    freed = deconvolved(noisy)
    step = 1e-3
    relation = calibrated()[2]
    mm_per_rad = (relation.height(freed.absolute + step) - relation.height(freed.absolute - step)) / (2 * step)
    within = np.abs(heights(freed) - truth) < 1.96 * np.abs(mm_per_rad) * freed.sigma
    assert 0.90 < within[where].mean() < 0.98
