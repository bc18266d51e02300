"""The prediction of blur times brightness: its blur against closed forms, the whole of it against rendered frames."""

from functools import lru_cache

import numpy as np
import pytest

import greenough.twin as gt
from greenough.instrument.contract import Placement
from greenough.pipeline.decode import decode
from greenough.pipeline.fringes import FringeSet
from greenough.pipeline.phase_height import PhaseHeight, fit_phase_height
from greenough.twin.diffraction import geometric_transfer, optical_transfer
from greenough.twin.settings import OpticsSettings
from greenough.twin.validation.evaluation import smooth
from greenough.twin.validation.prediction import LAYER_MM, blur, predict_height_error

AIRY_RADIUS_PX = 2.16
CROP = ("camera.rows=180", "camera.cols=240")  # 2.4 x 1.8 mm in the middle, in the pixels of the full camera
PERFECT_STAGE = ("position_sd_um", "straightness_sd_um", "pitch_roll_sd_urad", "axis_sd_deg")
PERFECT = ("twin.optics.glass=false", *(f"twin.stage.{name}=0" for name in PERFECT_STAGE))


def transfer(cycles_per_px: float, defocus: float, optics: OpticsSettings) -> float:
    pixel = optics.pupil_distance_mm / optics.camera_focal_px
    f = np.array(cycles_per_px / pixel)
    lens = optical_transfer(f, optics.na, optics.wavelength_um * 1e-3) * geometric_transfer(f, optics.na, defocus)
    return float(lens * np.sinc(cycles_per_px))


@pytest.mark.parametrize("defocus", [0.0, 2 * LAYER_MM, -1.4])
def test_blur_of_fringes_under_a_wave_of_brightness(defocus):
    """(1 + a cos qx) exp(ikx) is three waves: each is multiplied by its own transfer."""
    optics, subpixels, pixels = OpticsSettings(), 3, 120
    k, q, share = 6 / pixels, 15 / pixels, 0.6  # cycles per pixel
    x = np.arange(pixels * subpixels) / subpixels
    phasor = (1 + share * np.cos(2 * np.pi * q * x)) * np.exp(2j * np.pi * k * x)
    field = np.broadcast_to(phasor, (9, len(x))).astype(np.complex64)
    blurred = blur(field, np.full(field.shape, defocus, np.float32), subpixels, optics)
    expected = sum(
        weight * transfer(f, defocus, optics) * np.exp(2j * np.pi * f * x)
        for f, weight in ((k, 1.0), (k + q, share / 2), (k - q, share / 2))
    )
    # Between the layers the transfer function is interpolated: its second difference over 8.
    np.testing.assert_allclose(
        blurred, np.broadcast_to(expected, field.shape), atol=2e-3 if defocus % LAYER_MM else 1e-5
    )


@lru_cache
def calibrated(*overrides: str) -> tuple[gt.TwinRig, gt.Bench, PhaseHeight]:
    """A perfect instrument with a small picture, whose relation of phase and height is known from nine planes."""
    rig, bench = gt.open("twin", [*CROP, *PERFECT, "twin.board.ink_thickness_um=0", *overrides])
    rig.operator.place(Placement("plane"))
    heights = np.linspace(-0.4, 0.4, 9)
    phases = []
    for height in heights:
        rig.stage.move_to_mm(height)
        phases.append(phase(rig))
    rig.stage.move_to_mm(0.0)
    return rig, bench, fit_phase_height(np.stack(phases), heights).relation


def phase(rig: gt.TwinRig) -> np.ndarray:
    fringes = FringeSet(rig.procedure.periods_px, rig.procedure.steps)
    stack = rig.irradiance(fringes.patterns(*rig.projector.shape))
    return decode(stack / stack.max(), fringes).absolute


def errors(sample: str, *overrides: str) -> tuple[np.ndarray, np.ndarray]:
    """Measured and predicted height errors (n,) in um where the surface is smooth."""
    rig, bench, relation = calibrated(*overrides)
    rig.operator.place(Placement(sample))
    truth = bench.truth()
    measured = relation.height(phase(rig)) - truth.xyz_world[..., 2]
    predicted = predict_height_error(bench, rig.camera.shape, rig.projector.shape, rig.procedure.periods_px[-1])
    judged = smooth(truth, AIRY_RADIUS_PX)
    assert judged.mean() > 0.3
    return 1e3 * measured[judged], 1e3 * predicted[judged]


@pytest.mark.slow
@pytest.mark.parametrize(("sample", "strong"), [("coin", 3.0), ("bga", 3.0)])
def test_rendered_heights_err_as_predicted_from_brightness(sample, strong):
    measured, predicted = errors(sample, "twin.render.bounces=1")
    assert np.std(measured) > strong  # the effect is there
    assert np.sqrt(np.mean((measured - predicted) ** 2)) < 0.5


@pytest.mark.slow
def test_interreflections_hardly_matter_on_the_coin():
    measured, predicted = errors("coin")
    assert np.sqrt(np.mean((measured - predicted) ** 2)) < 0.5


def test_an_evenly_bright_plane_has_no_error():
    rig, bench, _ = calibrated("twin.render.bounces=1")
    rig.operator.place(Placement("plane"))
    predicted = predict_height_error(bench, rig.camera.shape, rig.projector.shape, rig.procedure.periods_px[-1])
    assert np.isfinite(predicted).all()
    assert np.abs(predicted).max() < 0.05e-3


@pytest.mark.slow
def test_pixels_without_light_have_no_prediction():
    rig, bench, _ = calibrated("twin.render.bounces=1")
    rig.operator.place(Placement("bga"))
    predicted = predict_height_error(bench, rig.camera.shape, rig.projector.shape, rig.procedure.periods_px[-1])
    truth = bench.truth()
    assert np.isfinite(predicted[truth.lit_and_seen]).all()
    assert np.isnan(predicted).any()


def test_pixels_are_divided_by_odd_numbers():
    _, bench, _ = calibrated("twin.render.bounces=1")
    with pytest.raises(ValueError, match="no ray in the middle"):
        predict_height_error(bench, (4, 4), (684, 608), 12.0, subpixels=2)
