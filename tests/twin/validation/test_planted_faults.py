"""Planted faults are found in recordings of a twin, one instrument each; tests/full has ten, and all calibrations."""

import pytest

from greenough.twin.validation.planted_faults import FAULTS, Outcome, diagnosed, outcome_table, record_fault

SEED = 21


@pytest.fixture(scope="module")
def seen():
    """What was rendered for one fault and need not be rendered for another."""
    return {}


@pytest.mark.slow
@pytest.mark.parametrize("fault", [name for name, planted in FAULTS.items() if planted.shown != "calibration"])
def test_a_fault_of_a_measurement_is_named_and_nothing_else(fault, seen, tmp_path):
    record_fault(fault, SEED, tmp_path / "recording.h5", seen)
    outcome = diagnosed(fault, SEED, tmp_path / "recording.h5")
    assert [finding.name for finding in outcome.found] == [name for name in [FAULTS[fault].finding] if name]
    assert outcome.as_it_should


def test_the_table_has_a_line_for_each_fault_and_a_column_for_each_seed():
    outcomes = [Outcome(fault, seed, int(bool(FAULTS[fault].finding)), ()) for fault in FAULTS for seed in (1, 2)]
    lines = outcome_table(outcomes).splitlines()
    assert len(lines) == 1 + len(FAULTS)
    assert lines[0].split()[-3:] == ["1", "2", "sound"]
    assert all(line.split()[-1] == "2" for line in lines[1:])
