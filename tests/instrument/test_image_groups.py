"""Files told apart by one pattern."""

from pathlib import Path

import pytest

from greenough.instrument.errors import InputError
from greenough.instrument.image_groups import grouped


def touch(folder: Path, *names: str) -> None:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).touch()


def names(groups: dict[str, list[str]]) -> dict[str, list[str]]:
    return {key: [Path(path).name for path in paths] for key, paths in groups.items()}


def test_folders_are_told_apart_in_natural_order(tmp_path: Path) -> None:
    touch(tmp_path, "board/pose_10/a.png", "board/pose_2/a.png", "board/notes.txt")
    assert names(grouped("board/pose_{}", tmp_path, "postures")) == {"2": ["pose_2"], "10": ["pose_10"]}


def test_files_of_one_folder_are_told_apart_by_their_names(tmp_path: Path) -> None:
    touch(tmp_path, "p1_f0_n10.png", "p1_f0_n2.png", "p12_f0_n0.png", "p12_f0_n0.txt", "q1.png")
    assert names(grouped("p{}_*.png", tmp_path, "postures")) == {
        "1": ["p1_f0_n2.png", "p1_f0_n10.png"],
        "12": ["p12_f0_n0.png"],
    }


def test_the_mark_may_name_the_folder_of_a_glob_and_does_not_reach_beyond_it(tmp_path: Path) -> None:
    touch(tmp_path, "a/f0.png", "a/f1.png", "b/f0.png", "b/c/f9.png")
    assert names(grouped("{}/f?.png", tmp_path, "planes")) == {"a": ["f0.png", "f1.png"], "b": ["f0.png"]}


def test_a_minus_sign_and_brackets_in_names_are_taken_as_they_stand(tmp_path: Path) -> None:
    touch(tmp_path, "run [1]/z-1.5.png", "run [1]/z+0.png", "run 1/z7.png")
    assert set(grouped("run [1]/z{}.png", tmp_path, "planes")) == {"-1.5", "+0"}


def test_a_path_may_lead_elsewhere(tmp_path: Path) -> None:
    touch(tmp_path, "images/p0.png", "rigs/rig.toml")
    assert list(grouped("../images/p{}.png", tmp_path / "rigs", "postures")) == ["0"]
    assert list(grouped(f"{tmp_path}/images/p{{}}.png", tmp_path / "rigs", "postures")) == ["0"]


@pytest.mark.parametrize("pattern", ["board/*", "{}/{}.png"])
def test_a_pattern_has_one_mark(tmp_path: Path, pattern: str) -> None:
    with pytest.raises(InputError, match=r"images\.postures = .* must have one \{\}"):
        grouped(pattern, tmp_path, "images.postures")


def test_a_pattern_that_nothing_matches_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"images\.planes = .*nothing in .* matches it"):
        grouped("planes/z{}", tmp_path, "images.planes")
