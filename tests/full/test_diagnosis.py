"""A fault planted in a twin is what `diagnose` names first, and nothing is named where none was planted.

``pytest -m full -s tests/full/test_diagnosis.py`` prints the table of faults and instruments.
"""

import pytest

from greenough.twin.validation.planted_faults import FAULTS, diagnosed, outcome_table, record_fault

pytestmark = pytest.mark.full
SEEDS = range(1, 11)


@pytest.fixture(scope="module")
def outcomes(request, tmp_path_factory):
    """Of every fault in every instrument; the table is printed."""
    folder, found = tmp_path_factory.mktemp("diagnosed"), []
    for seed in SEEDS:
        seen = {}
        for fault in FAULTS:
            path = folder / "recording.h5"
            record_fault(fault, seed, path, seen)
            found.append(diagnosed(fault, seed, path))
            path.unlink()
    with request.config.pluginmanager.getplugin("capturemanager").global_and_fixture_disabled():
        print(f"\n{outcome_table(found)}")
    return found


@pytest.mark.parametrize("fault", [name for name, planted in FAULTS.items() if planted.finding])
def test_the_planted_fault_is_named_first_in_nine_of_ten(outcomes, fault):
    assert sum(outcome.as_it_should for outcome in outcomes if outcome.fault == fault) >= 9


@pytest.mark.parametrize("fault", [name for name, planted in FAULTS.items() if not planted.finding])
def test_nothing_is_found_where_nothing_was_planted(outcomes, fault):
    assert sum(outcome.as_it_should for outcome in outcomes if outcome.fault == fault) == len(SEEDS)
