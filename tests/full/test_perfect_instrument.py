"""The whole chain on an instrument without errors: what is left is the chain's own error.

Stage and board are perfect and the camera has neither noise nor quantisation. Nothing is aligned: heights are compared
in the calibrated frame, along each pixel's ray.
"""

import numpy as np
import pytest

import greenough.twin as gt
from greenough.instrument.contract import Placement
from greenough.pipeline.acquisition import calibrate, measure
from greenough.pipeline.calibration import Calibration
from greenough.pipeline.decode import decode
from greenough.pipeline.exposure import auto_exposure
from greenough.pipeline.reconstruct import PointMap, reconstruct
from greenough.twin.validation.evaluation import smooth
from greenough.twin.validation.prediction import predict_height_error

AIRY_RADIUS_PX = 2.16
PERFECT = (
    "twin.optics.glass=false",
    "camera.bits=0",
    *(f"twin.camera.{name}" for name in ("shot_noise=false", "read_noise_e=0", "prnu=0", "dsnu_e=0")),
    *(f"twin.stage.{n}=0" for n in ("position_sd_um", "straightness_sd_um", "pitch_roll_sd_urad", "axis_sd_deg")),
    *(f"twin.board.{n}=0" for n in ("print_sd_um", "scale_sd_ppm", "bow_sd_um", "wedge_sd_urad", "ink_thickness_um")),
    "twin.light.ambient=0",
    *(f"twin.stability.{name}=0" for name in ("flicker", "vibration_um", "table_drift_um", "path_drift_um")),
)
PINHOLES = (
    "twin.optics.finite_aperture=false",
    "twin.optics.camera_diffraction=false",
    "twin.render.diffuse_only=true",
)
OPTICS = {"pinholes": PINHOLES, "lenses": ()}
DIRECT = "twin.render.bounces=1"  # the independent prediction knows nothing of interreflections

BETWEEN_PLANES = (-1.12, 0.13, 1.37)  # the calibration's are at odd multiples of 0.05


@pytest.fixture(scope="module", params=OPTICS)
def optics(request) -> str:
    return request.param


@pytest.fixture(scope="module")
def calibration(optics, tmp_path_factory) -> Calibration:
    rig, _ = gt.open("twin", [*PERFECT, *OPTICS[optics], DIRECT], run="calibration")
    with rig:
        return calibrate(rig, tmp_path_factory.mktemp(optics) / "calibration.h5", run="calibration", method="paper")


def measurement(optics: str) -> tuple[gt.TwinRig, gt.Bench]:
    return gt.open("twin", [*PERFECT, *OPTICS[optics], DIRECT], run="measurement")


def height_error_um(points: PointMap, bench: gt.Bench) -> np.ndarray:
    """(rows, cols), NaN where the point is not valid or the surface not smooth."""
    truth = bench.truth()
    judged = smooth(truth, AIRY_RADIUS_PX) & points.valid
    return np.where(judged, 1e3 * (points.xyz[..., 2] - truth.xyz_world[..., 2]), np.nan)


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.nanmean(values**2)))


def test_planes_between_the_calibration_heights_to_200_nm(calibration, optics, figure):
    rig, bench = measurement(optics)
    rig.operator.place(Placement("plane"))
    for z in BETWEEN_PLANES:
        rig.stage.move_to_mm(z)
        auto_exposure(rig)
        frames = rig.capture(calibration.fringes.patterns(*rig.projector.shape))
        points = reconstruct(decode(frames, calibration.fringes, rig.camera.noise), calibration)
        error = height_error_um(points, bench)
        assert np.isfinite(error).mean() > 0.35  # the calibration board covers 8 mm, the light 6.1 mm
        figure(f"perfect instrument, {optics}: plane at {z} mm, RMS", rms(error), 0.2, "um")
        assert rms(error) <= 0.2


@pytest.mark.parametrize("sample", ["coin", "bga"])
def test_specimens_to_200_nm_through_pinholes_and_as_predicted_through_lenses(calibration, optics, sample, figure):
    rig, bench = measurement(optics)
    lenses = optics == "lenses"
    points = measure(rig, calibration, Placement(sample), (4.0, 1.0) if lenses else (1.0,))
    error = height_error_um(points, bench)
    assert np.isfinite(error).sum() > 0.1 * error.size
    if lenses:
        figure(f"perfect instrument, lenses: {sample}, RMS before the prediction", rms(error), np.inf, "um")
        shapes = rig.camera.shape, rig.projector.shape
        error = error - 1e3 * predict_height_error(bench, *shapes, rig.procedure.periods_px[-1])
    bar = 0.5 if lenses else 0.2
    name = "against the prediction" if lenses else "against the mesh"
    figure(f"perfect instrument, {optics}: {sample} {name}, RMS", rms(error), bar, "um")
    assert rms(error) <= bar
