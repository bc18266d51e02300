from typing import Any

import numpy as np
import pytest

from greenough.instrument.errors import InputError
from greenough.pipeline.bundle_method import MIN_BLOCKS, calibrate_by_bundle
from greenough.pipeline.calibration_data import CalibrationData


@pytest.mark.parametrize(("plane", "which"), [(0, "at stage position 0"), (1, "of plane 00"), (7, "of plane 06")])
def test_a_plane_with_too_little_phase_is_named(plane, which):
    """Before anything else is looked at."""
    phases = np.zeros((11, 240, 320), dtype=np.float32)
    phases[plane, 40:] = np.nan
    phases[plane, :, 6 * 8 :] = np.nan  # five rows of six blocks are left, less one
    phases[plane, 32:40, :8] = np.nan
    anything: Any = None
    data = CalibrationData(
        identity=anything,
        board=anything,
        procedure=anything,
        known=anything,
        run="run",
        exposures=0,
        spots=(),
        spot_phases=(),
        exposures_at_postures=np.zeros(0, dtype=int),
        missing=(),
        camera=anything,
        point_spread=None,
        phase_at_zero=phases[0],
        phases=phases[1:],
        readings_mm=np.arange(10.0),
    )
    with pytest.raises(InputError, match=f"the blank side {which} fills only {MIN_BLOCKS - 1} of the blocks"):
        calibrate_by_bundle(data)
