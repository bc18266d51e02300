"""Claims about the step, measured by setups whose errors are known."""

from types import SimpleNamespace

import numpy as np
import pytest

from greenough.pipeline.reconstruct import PointMap
from greenough.twin.validation.setup import Setup
from greenough.twin.validation.step import LIMITS_UM, STEP_MM, step_claims

STAGE_ERROR_MM = {-STEP_MM / 2: 4e-3, STEP_MM / 2: -3e-3}


class SteppingSetup(Setup):
    """Whose stage errs, and whose points are the plane's but for a wrong scale of depth."""

    def place(self, placement, position=0.0):
        pass

    def frames(self):
        return SimpleNamespace(serials=[0])

    def decoded(self, frames):
        return None

    def points(self, phase_map):
        height = self.bench.world_from_part[2, 3]
        return PointMap(np.full((8, 8, 3), [0.0, 0.0, self.calibration.scale * height]))


def stepping(analytic, method: str, scale: float) -> Setup:
    motion = np.eye(4)
    setup = analytic(motion, method=method)

    def move_to_mm(position: float) -> None:
        motion[2, 3] = position + STAGE_ERROR_MM[position]

    setup.rig.stage = SimpleNamespace(move_to_mm=move_to_mm, reading=None, limits_mm=(-1.6, 1.6))
    setup.calibration.scale = scale
    return SteppingSetup(setup.rig, setup.bench, setup.calibration)


@pytest.mark.parametrize("method", ["bundle", "paper"])
@pytest.mark.parametrize(("error_um", "holds_for_bundle"), [(0.3, True), (-0.7, False)])
def test_the_step_is_judged_against_what_the_stage_really_did(analytic, method, error_um, holds_for_bundle):
    true_step = STEP_MM - 7e-3
    (row,) = step_claims([stepping(analytic, method, 1 + 1e-3 * error_um / true_step)])
    assert row.measured == pytest.approx(error_um, abs=1e-6)
    assert f"{true_step:.4f} mm" in row.criterion
    assert row.limit == LIMITS_UM[method] == {"bundle": 0.5, "paper": 4.0}[method]
    assert row.holds is (holds_for_bundle or method == "paper")
    assert row.expected_to_hold is True
    assert (row.predicted is None) == (method == "bundle")
