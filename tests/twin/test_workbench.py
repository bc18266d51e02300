"""Claims about what lies on the bench."""

import numpy as np
import pytest

import greenough.twin as gt
from greenough.instrument.contract import Placement

PRINT_OFF = "twin.board.print_sd_um=0"


def centres(part: str, *overrides: str) -> np.ndarray:
    """Printed centres of one of the boards, (spots, 2) mm."""
    rig, bench = gt.open("twin", overrides)
    rig.operator.place(Placement(part))
    return bench.specimen.as_built["centres_mm"][:, :2]


@pytest.mark.parametrize("seed", [1, 2])
def test_a_known_scale_error_is_printed_on_the_calibration_board_alone(seed):
    """Both keep the scales that were drawn for them: the error is added to that of the calibration board."""
    overrides = (f"twin.seed={seed}", PRINT_OFF)
    rig, _ = gt.open("twin", overrides)
    planted = (*overrides, "twin.board.scale_error_ppm=1000")
    shift = centres("board", *planted) - centres("board", *overrides)
    np.testing.assert_allclose(shift, 1e-3 * rig.board.centres(), atol=1e-12)
    np.testing.assert_array_equal(centres("second-board", *planted), centres("second-board", *overrides))
    assert np.abs(centres("second-board", *overrides) - rig.board.centres()).max() > 1e-6
