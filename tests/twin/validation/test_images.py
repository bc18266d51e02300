"""A coin on the coarse twin, measured from images alone: in folders, in another order, with a rig file of their own."""

from pathlib import Path

import numpy as np
import pytest

from greenough.instrument import Placement, open_rig
from greenough.pipeline.acquisition import calibrate, measure
from image_folders import keep, keep_as_it_lies, rig_file

# Pixels of 40 um; the spots are larger in proportion, or they would not be found.
COARSE = (
    "twin.optics.glass=false", "camera.rows=240", "camera.cols=320", "twin.optics.camera_focal_px=5670.75",
    "twin.render.nodes=8", "board.small_diameter_mm=0.3", "board.big_diameter_mm=0.5", "procedure.postures=8",
    "twin.render.bounces=1",
)  # fmt: skip


@pytest.mark.slow
def test_a_coin_from_images_is_the_coin_that_the_rig_measures(tmp_path: Path):
    """Other exposures, set by hand, and noise that nobody stated: both differ by what both state, not more or less."""
    with open_rig("twin", COARSE, run="theirs") as rig:
        rig.camera.exposure_us = 70_000
        keep(rig, tmp_path, ())
        rig.operator.place(Placement("coin"))
        rig.camera.exposure_us = 25_000
        keep_as_it_lies(rig, tmp_path / "coin")
        (tmp_path / "rig.toml").write_text(rig_file(rig).partition("planes =")[0])
    with open_rig(tmp_path / "rig.toml") as images:
        calibration = calibrate(images, tmp_path / "theirs.h5", method="stage-free")
        theirs = measure(images, calibration, Placement(str(tmp_path / "coin")))
    with open_rig("twin", COARSE, run="ours") as rig:
        calibration = calibrate(rig, tmp_path / "ours.h5", "ours", method="stage-free")
    with open_rig("twin", COARSE, run="our coin") as rig:
        ours = measure(rig, calibration, Placement("coin"))
    both = theirs.valid & ours.valid
    assert both.sum() > 0.9 * ours.valid.sum()
    difference = (theirs.xyz - ours.xyz)[both]
    calibrations = np.median(np.hypot(theirs.sigma_calibration, ours.sigma_calibration)[both], axis=0)
    assert np.all(np.abs(np.median(difference, axis=0)) < 3 * calibrations)
    assert np.all(calibrations < 3e-3)  # mm
    stated = np.hypot(theirs.sigma_noise, ours.sigma_noise)[both]
    scatter = np.median(np.abs(difference[:, 2] / stated[:, 2])) / 0.6745
    assert scatter == pytest.approx(1.0, abs=0.15)
