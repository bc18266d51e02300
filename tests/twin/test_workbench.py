"""Claims about what lies on the bench."""

import numpy as np
import pytest
import trimesh

import greenough.twin as gt
from greenough.instrument.contract import Placement
from greenough.instrument.errors import InputError

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


@pytest.mark.slow
def test_a_mesh_file_is_of_the_material_that_was_asked_for(tmp_path, small):
    """Under even light a board of ceramic sends back as much more than one of ink as their reflectances say."""
    corners = np.array([[-6.0, -4, 0], [6, -4, 0], [6, 4, 0], [-6, 4, 0]])
    trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]]).export(tmp_path / "sheet.stl")
    rig, _ = small(noiseless=True)
    white = np.full((1, *rig.projector.shape), 255, np.uint8)
    grey = {}
    for material in ("ceramic", "ink", None):
        rig.operator.place(Placement(str(tmp_path / "sheet.stl"), material=material))
        grey[material] = np.median(rig.capture(white).stack) - rig.camera.black_level_dn
    assert grey["ceramic"] / grey["ink"] == pytest.approx(0.85 / 0.08, rel=1e-3)
    assert grey[None] / grey["ink"] == pytest.approx(0.6 / 0.08, rel=1e-3)


@pytest.mark.parametrize(
    ("placement", "sentence"),
    [
        (Placement("coin", material="metal"), "the coin has materials of its own"),
        (Placement("board", material="metal"), "the board has materials of its own"),
        (Placement("part.stl", material="cheese"), "choose one of ceramic"),
    ],
)
def test_a_material_that_cannot_be_is_refused(small, placement, sentence):
    rig, _ = small()
    with pytest.raises(InputError, match=sentence):
        rig.operator.place(placement)
