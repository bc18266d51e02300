from pathlib import Path

import pytest

from greenough.instrument import open_rig
from greenough.instrument.contract import Placement
from greenough.instrument.errors import InputError
from greenough.instrument.recording import record
from greenough.instrument.rigfile import RigFile

DRIVER = """
def connect(rig_file, *, run, exposures_done):
    return rig_file, run, exposures_done
"""


def test_the_driver_gets_the_rig_file_the_run_and_the_count(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "lab_driver.py").write_text(DRIVER)
    monkeypatch.syspath_prepend(tmp_path)
    opened = open_rig("twin", ['driver="lab_driver:connect"', "twin.seed=7"], run="monday", exposures_done=24)
    rig_file, run, exposures_done = opened
    assert isinstance(rig_file, RigFile)
    assert rig_file.driver_section("twin")["seed"] == 7
    assert (run, exposures_done) == ("monday", 24)


@pytest.mark.parametrize("driver", ["no_such_module:connect", "json.no_such_module:connect", "json:no_such_function"])
def test_a_driver_that_is_not_there_is_named(driver: str) -> None:
    with pytest.raises(InputError, match=driver):
        open_rig("twin", [f'driver="{driver}"'])


def test_a_driver_that_misses_a_module_of_its_own_stays_a_traceback(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "broken_driver.py").write_text("import a_module_it_forgot")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ModuleNotFoundError, match="a_module_it_forgot"):
        open_rig("twin", ['driver="broken_driver:connect"'])


def test_an_unknown_rig_is_refused() -> None:
    with pytest.raises(InputError, match="built-in"):
        open_rig("no-such-rig")


def test_an_h5_path_is_replayed_and_takes_no_overrides(tmp_path: Path, fake_rig, patterns) -> None:
    path = tmp_path / "rig.h5"
    with record(fake_rig(), path) as rig:
        rig.operator.place(Placement("board"))
        rig.capture(patterns)
    assert open_rig(path).identity == fake_rig().identity
    assert open_rig(str(path)).identity == fake_rig().identity
    with pytest.raises(InputError, match=r"--set twin\.seed=2"):
        open_rig(path, ["twin.seed=2"])
