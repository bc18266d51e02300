"""What the wire does wrong in a calibration ends in no wrong number: each fault once, several in one calibration.

tests/full has each of them, and two that take long, at many random points of calibrations of their own.
"""

from random import Random

import pytest
from emulated_gige import need_aravis
from faulty_calibration import DEVIATION_LIMIT, ERROR_LIMIT_UM, Bench, left_since, missing_exposures, resources
from plain_scene import largest_error_um
from process_faults import PROCESS_KINDS, broken_claims_of_process, run_process
from wire_faults import KINDS, broken_by_call, order

# A fault is never judged by how long a busy machine takes.
pytestmark = [pytest.mark.wire, pytest.mark.timeout(1200)]
HARMLESS = [name for name, kind in KINDS.items() if kind.harmless]
LONG = ("all devices: silent", "camera: silent")  # Aravis has time-outs of its own
A_STEP = 0.06  # of a calibration


def harmful(*devices: str) -> list[str]:
    return [name for name, kind in KINDS.items() if not kind.harmless and name.startswith(devices) and name not in LONG]


@pytest.fixture
def bench(tmp_path):
    """Emulated devices, and the check that nothing is left of them and of their rig."""
    need_aravis()
    before = resources()
    with Bench(tmp_path) as opened:
        yield opened
    assert left_since(before) == ()


@pytest.mark.slow
def test_harmless_faults_change_no_number(bench):
    for name in HARMLESS:
        order(bench, KINDS[name], Random(name))
    call = bench.call()
    assert [broken_by_call(KINDS[name], call) for name in HARMLESS] == [[]] * len(HARMLESS)
    least, most = missing_exposures(())
    assert least <= call.exposures <= most
    assert largest_error_um(call.calibration) < ERROR_LIMIT_UM


@pytest.mark.slow
@pytest.mark.parametrize(
    "names",
    [harmful("projector"), harmful("stage"), harmful("camera", "operator", "interrupt")],
    ids=["projector", "stage", "others"],
)
def test_each_fault_is_told_leaves_all_safe_and_the_next_call_goes_on(bench, names):
    """One calibration in many calls, each of which a fault strikes within its first captures."""
    homes = False
    for name in names:
        kind = KINDS[name]
        kept = bench.kept
        order(bench, kind, Random(name), A_STEP)
        call = bench.call(home_first=homes)
        assert (name, call.error, broken_by_call(kind, call)) == (name, call.error, [])
        assert set(kept) <= set(bench.kept)
        kind.mend(bench)
        homes = kind.homes
    least, most = missing_exposures(bench.kept)
    last = bench.call(home_first=homes)
    assert last.error is None
    assert least <= last.exposures <= most
    assert not last.lit_after_connecting
    assert last.worst_deviation < DEVIATION_LIMIT
    assert largest_error_um(last.calibration) < ERROR_LIMIT_UM


@pytest.mark.slow
@pytest.mark.parametrize("name", ["process: killed", "process: SIGTERM to its group"])
def test_a_calibration_whose_process_is_ended_goes_on(name, tmp_path):
    need_aravis()
    ended, after = run_process(name, 0, tmp_path)
    assert broken_claims_of_process(PROCESS_KINDS[name], ended, after) == []


@pytest.mark.slow
def test_a_wrong_frame_would_be_noticed(bench):
    """The camera sees, once, what was shown for the pattern before."""
    expose = bench.scene.expose

    def repeat_one(patterns, exposure_us, serial, began, lamp):
        frames = expose(patterns, exposure_us, serial, began, lamp)
        if len(frames) > 9 and began > 120:
            frames[9] = frames[8]
        return frames

    bench.scene.expose = repeat_one
    call = bench.call()
    assert call.worst_deviation > 10 * DEVIATION_LIMIT
    assert call.error is not None or largest_error_um(call.calibration) > ERROR_LIMIT_UM
