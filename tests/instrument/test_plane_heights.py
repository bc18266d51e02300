"""How high planes lay, by a list, a file, or their names."""

from pathlib import Path

import pytest

from greenough.instrument.errors import InputError
from greenough.instrument.image_rig_settings import ImagesSection
from greenough.instrument.plane_heights import plane_heights


def heights(folder: Path, names: list[str], **said: object) -> dict[str, float]:
    return plane_heights(ImagesSection(postures="board/{}", planes="planes/{}", **said), names, folder)


def test_a_list_goes_with_the_names_and_may_fall(tmp_path: Path) -> None:
    assert heights(tmp_path, ["1", "2", "10"], heights_mm=(0.5, 0.0, -0.25)) == {"10": -0.25, "2": 0.0, "1": 0.5}
    assert list(heights(tmp_path, ["1", "2", "10"], heights_mm=(0.5, 0.0, -0.25))) == ["10", "2", "1"]


def test_names_that_are_numbers_count_from_a_zero_in_steps(tmp_path: Path) -> None:
    assert heights(tmp_path, ["0", "1", "2"], plane_step_mm=0.5, plane_zero=1.0) == {"0": -0.5, "1": 0.0, "2": 0.5}
    falling = heights(tmp_path, ["-1.5", "+0", "2"], plane_step_mm=-1.0)  # a stage that counts downwards
    assert falling == {"2": -2.0, "+0": 0.0, "-1.5": 1.5}


def test_a_file_names_planes_and_heights_in_any_order(tmp_path: Path) -> None:
    (tmp_path / "z.csv").write_text("plane,z in mm\nhigh, 0.5\n\nlow,-0.5\nmiddle,0\nunused,7\n", encoding="utf-8-sig")
    found = heights(tmp_path, ["high", "low", "middle"], heights_file="z.csv")
    assert found == {"low": -0.5, "middle": 0.0, "high": 0.5}
    with pytest.raises(InputError, match="there is none for the plane top"):
        heights(tmp_path, ["high", "top"], heights_file="z.csv")


@pytest.mark.parametrize("line", ["a,b", "a", "a,1,2", "a,nan", "a,1e9", "first,2"])
def test_a_line_that_is_no_name_and_height_is_shown(tmp_path: Path, line: str) -> None:
    (tmp_path / "z.csv").write_text(f"first,1\n{line}\n")
    with pytest.raises(InputError, match=rf"line 2: '{line}' must be a plane's name"):
        heights(tmp_path, ["first"], heights_file="z.csv")


def test_a_file_that_is_not_text_is_refused(tmp_path: Path) -> None:
    (tmp_path / "z.csv").write_bytes(b"\xff\xfe\x00\x01")
    with pytest.raises(InputError, match=r"z\.csv cannot be read"):
        heights(tmp_path, ["first"], heights_file="z.csv")
    with pytest.raises(InputError, match=r"nothing\.csv cannot be read: No such file"):
        heights(tmp_path, ["first"], heights_file="nothing.csv")
