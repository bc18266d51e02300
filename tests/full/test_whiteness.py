"""Nothing is left in a plane but the camera's noise, once flicker, vibration and the calibration's error are off.

The calibration's error is switched off by calibrating the same instrument with a camera without noise, a stage and a
board without error: every pixel's relation is then its own true one, to the sampling floor. Planes are measured with
the camera's noise, with stage and board as they are, and at heights between the calibration's.
"""

import numpy as np
import pytest

import greenough.twin as gt
from greenough.instrument.contract import Placement
from greenough.pipeline.acquisition import calibrate
from greenough.pipeline.calibration import Calibration
from greenough.twin.validation.planes import count, rms, without_plane
from greenough.twin.validation.setup import Setup
from greenough.twin.validation.structure import structure
from greenough.twin.validation.whiteness import detectable, whiteness

FALSE_ALARMS = 1e-3  # for each plane
GLASS = "twin.optics.glass=true"
STABLE = tuple(f"twin.stability.{name}=0" for name in ("flicker", "vibration_um", "table_drift_um", "path_drift_um"))
EXACT = (
    "camera.bits=0",
    *(f"twin.camera.{name}" for name in ("shot_noise=false", "read_noise_e=0", "prnu=0", "dsnu_e=0")),
    *(f"twin.stage.{n}=0" for n in ("position_sd_um", "straightness_sd_um", "pitch_roll_sd_urad", "axis_sd_deg")),
    *(f"twin.board.{n}=0" for n in ("print_sd_um", "scale_sd_ppm", "bow_sd_um", "wedge_sd_urad", "ink_thickness_um")),
    # Without errors fewer postures and planes say as much.
    "procedure.postures=6", "procedure.planes=10", "procedure.plane_step_mm=0.3",
)  # fmt: skip


@pytest.fixture(scope="module")
def calibration(tmp_path_factory) -> Calibration:
    rig, _ = gt.open("twin", [GLASS, *STABLE, *EXACT], run="calibration")
    out = tmp_path_factory.mktemp("exact") / "calibration.h5"
    with rig:
        return calibrate(rig, out, run="calibration", method="paper")


def departures(calibration: Calibration, overrides: tuple[str, ...], height: float) -> tuple[np.ndarray, np.ndarray]:
    """Of one exposure of a plane, and their standard deviation as the frames' noise predicts it, (rows, cols) um."""
    rig, bench = gt.open("twin", [GLASS, *overrides], run="measurement")
    setup = Setup(rig, bench, calibration)
    with rig:
        setup.place(Placement("plane"), height)
        phase_map = setup.capture()
        return 1e3 * without_plane(setup, setup.points(phase_map)), 1e3 * setup.height_sigma(phase_map)


@pytest.mark.parametrize("height", [-1.1, 0.1, 0.9])
def test_a_plane_s_departures_are_white(calibration, height, figure):
    residual, sigma = departures(calibration, STABLE, height)
    found = whiteness(residual, sigma)
    for side in (1, 4, 16):
        size = detectable(rms(residual), count(residual), side, FALSE_ALARMS)
        figure(f"plane at {height} mm: structure of {side} px that is found in half of all cases", size, np.inf, "um")
    figure(f"plane at {height} mm: structure beyond white noise", structure(residual), 0.5, "um")
    figure(f"plane at {height} mm: probability of its correlations in white noise", found.p_value, FALSE_ALARMS, "")
    assert found.p_value > FALSE_ALARMS
    assert structure(residual) < 0.05


@pytest.mark.parametrize(
    "change", [("twin.stability.flicker=0.005",), ("twin.stability.vibration_um=1",)], ids=["flicker", "vibration"]
)
def test_flicker_and_vibration_are_found(calibration, change, figure):
    """Five and ten times their defaults, which leave a ripple along the fringes of about the size that can be found."""
    residual, sigma = departures(calibration, (*STABLE, *change), 0.1)
    p_value = whiteness(residual, sigma).p_value
    figure(f"{change[0]}: probability of its correlations in white noise", p_value, FALSE_ALARMS, "")
    assert p_value < FALSE_ALARMS


def test_a_wave_of_a_tenth_of_a_micrometre_is_found(calibration, figure):
    residual, sigma = departures(calibration, STABLE, 0.1)
    wave = 0.1 * np.sqrt(2) * np.sin(2 * np.pi * np.arange(residual.shape[1]) / 64)
    p_value = whiteness(residual + wave, sigma).p_value
    figure("wave of 0.1 um: probability of its correlations in white noise", p_value, FALSE_ALARMS, "")
    assert p_value < FALSE_ALARMS
