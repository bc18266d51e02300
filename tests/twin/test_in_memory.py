"""Claims about kernels that serve every instrument of a kind."""

from collections.abc import Sequence

import numpy as np
import pytest

import greenough.twin as gt
from greenough.instrument.contract import Placement
from greenough.twin.in_memory import in_memory
from greenough.twin.renderer import dr, mi
from greenough.twin.rig import fringe_patterns

COARSE = ("camera.rows=60", "camera.cols=80", "twin.optics.camera_focal_px=1417.6875")


def captures(seed: int, samples: Sequence[str]) -> list[np.ndarray]:
    """Fringes on each of the samples by one instrument in glass, with all its errors."""
    rig, _ = gt.open("twin", [*COARSE, f"twin.seed={seed}"])
    stacks = []
    for sample in samples:
        rig.operator.place(Placement(sample))
        rig.capture(np.full((1, *rig.projector.shape), 255, np.uint8))  # as exposures are set
        stacks.append(rig.capture(fringe_patterns(rig)).stack)
    return stacks


@pytest.mark.slow
def test_a_second_instrument_compiles_nothing_from_its_opening_to_its_frames() -> None:
    samples = ("board", "step-gauge")  # flat and with relief
    first = captures(21, samples)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        second = captures(22, samples)
        kernels = [entry for entry in dr.kernel_history() if entry["type"] == dr.KernelType.JIT]
    assert kernels  # it did compute
    assert sum(not kernel["cache_hit"] for kernel in kernels) == 0
    for one, other in zip(first, second, strict=True):
        assert (one != other).mean() > 0.1  # by other lenses, not only with other noise


@pytest.mark.parametrize("value", [0.25, -1e-9])
def test_kernels_do_not_depend_on_numbers_in_memory(value: float) -> None:
    x = mi.Float([1.0, 2.0, 4.0])
    hashes = set()
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        for number in (value, 3.0):
            dr.kernel_history_clear()
            y = x * in_memory(mi.Float, number)
            dr.eval(y)
            assert np.array(y) == pytest.approx(np.array([1.0, 2.0, 4.0]) * number)
            hashes |= {entry["hash"] for entry in dr.kernel_history() if entry["type"] == dr.KernelType.JIT}
    assert len(hashes) == 1


def test_what_is_as_designed_stays_in_the_code() -> None:
    assert [in_memory(mi.Float, value) for value in (0.0, 1.0)] == [0.0, 1.0]
