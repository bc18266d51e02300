"""Claims about ``greenough optics`` and its pictures."""

import json
from importlib.metadata import EntryPoint

import cv2
import pytest

from greenough.instrument.command import GROUP, run


@pytest.fixture
def greenough(capsys):
    def call(*arguments):
        source = EntryPoint("optics", "greenough.twin.glass.commands:app", GROUP)
        code = run(["optics", *map(str, arguments)], [source])
        printed = capsys.readouterr()
        return code, printed.out, printed.err

    return call


@pytest.mark.slow
def test_optics_draws_both_paths_and_sums_them_up(greenough, tmp_path):
    code, out, err = greenough("twin", "--out", tmp_path / "optics", "--json")
    assert (code, err) == (0, "")
    result = json.loads(out)
    assert result["camera"]["pinhole_focal_length_px"] == pytest.approx([22683.0, 22683.0], abs=0.1)
    assert result["projector"]["magnification"] == pytest.approx(0.606061, abs=1e-6)
    assert len(result["files"]) == 6
    for file in result["files"]:
        picture = cv2.imread(file)
        assert picture is not None
        assert picture.std() > 10


def test_another_rig_is_refused(greenough, tmp_path):
    code, _, err = greenough("nowhere.toml", "--out", tmp_path)
    assert code == 2
    assert "nowhere.toml" in err


def test_a_file_in_the_folders_place_is_refused(greenough, tmp_path):
    (tmp_path / "taken").write_text("")
    code, _, err = greenough("twin", "--out", tmp_path / "taken")
    assert code == 2
    assert "taken" in err
