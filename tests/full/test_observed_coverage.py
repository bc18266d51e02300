"""The bundle on one instrument's observations, from drawing to intervals."""

import numpy as np
import pytest

from greenough.twin.validation.coverage import MEASURANDS
from greenough.twin.validation.observed_captures import observed_coverage

COARSE = [
    "camera.rows=360", "camera.cols=480", "twin.optics.camera_focal_px=8506.125", "twin.render.nodes_edges=16",
    "procedure.postures=8", "procedure.planes=8", "procedure.plane_step_mm=0.4",
]  # fmt: skip


def test_observations_calibrate_and_measure_within_a_few_stated_uncertainties():
    """At this camera's few pixels nothing is better than the study says: no error beyond six of them."""
    rows = observed_coverage("twin", COARSE, "coverage", lambda _: None)
    assert [row["measurand"] for row in rows] == list(MEASURANDS)
    for row in rows:
        assert row["u_um"] == pytest.approx(np.hypot(row["u_noise_um"], row["u_calibration_um"]))
        assert 0 < abs(row["error_um"]) < 6 * row["u_um"]
        assert row["hit"] == (abs(row["error_um"]) <= 1.959964 * row["u_um"])
