"""What the wire can do wrong in a whole calibration, each at random points of it, and what comes of that.

``pytest -m full -s tests/full/test_calibration_faults.py`` prints the table of faults and outcomes.
"""

import pytest
from emulated_gige import need_aravis
from fault_table import FaultTable
from faulty_calibration import DEVIATION_LIMIT, ERROR_LIMIT_UM
from process_faults import PROCESS_KINDS, broken_claims_of_process, run_process
from wire_faults import KINDS, broken_claims, run

pytestmark = pytest.mark.full
SEEDS, PROCESS_SEEDS = 6, 4


@pytest.fixture(scope="module")
def table(request):
    """Collects what comes of the runs, and prints it."""
    outcomes = FaultTable()
    yield outcomes
    with request.config.pluginmanager.getplugin("capturemanager").global_and_fixture_disabled():
        print(f"\n{outcomes}")


def test_there_are_200_runs_and_more():
    assert len(KINDS) * SEEDS + len(PROCESS_KINDS) * PROCESS_SEEDS >= 200
    assert DEVIATION_LIMIT < 10
    assert ERROR_LIMIT_UM < 10


@pytest.mark.parametrize("seed", range(SEEDS))
@pytest.mark.parametrize("name", KINDS)
def test_a_fault_at_a_random_point_ends_in_no_wrong_number_and_the_calibration_goes_on(name, seed, table, tmp_path):
    need_aravis()
    outcome = run(name, seed, tmp_path)
    table.add(name, KINDS[name].bound_s, outcome)
    assert broken_claims(KINDS[name], outcome) == []


@pytest.mark.parametrize("seed", range(PROCESS_SEEDS))
@pytest.mark.parametrize("name", PROCESS_KINDS)
def test_a_calibration_whose_process_is_ended_goes_on(name, seed, table, tmp_path):
    need_aravis()
    ended, outcome = run_process(name, seed, tmp_path)
    table.add_process(name, ended, outcome)
    assert broken_claims_of_process(PROCESS_KINDS[name], ended, outcome) == []
