import hashlib
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from greenough.instrument.errors import InputError
from greenough.instrument.files import atomic_path, sha256_of_file


def test_the_file_appears_whole_and_alone(tmp_path: Path) -> None:
    target = tmp_path / "cloud.ply"
    with atomic_path(target) as path:
        assert path.suffix == ".ply"
        assert path.parent == tmp_path
        path.write_text("whole")
        assert not target.exists()
    assert [file.name for file in tmp_path.iterdir()] == ["cloud.ply"]
    assert target.read_text() == "whole"


@pytest.mark.parametrize("error", [KeyboardInterrupt, SystemExit, RuntimeError])
def test_an_exception_keeps_what_was_there(tmp_path: Path, error: type[BaseException]) -> None:
    target = tmp_path / "cloud.ply"
    target.write_text("before")

    def write_half() -> None:
        with atomic_path(target) as path:
            path.write_text("half")
            raise error

    with pytest.raises(error):
        write_half()
    assert [file.name for file in tmp_path.iterdir()] == ["cloud.ply"]
    assert target.read_text() == "before"


def test_an_exception_before_writing_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError), atomic_path(tmp_path / "a.h5"):
        raise RuntimeError
    assert list(tmp_path.iterdir()) == []


def test_a_missing_folder_and_a_folder_as_target_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no folder"), atomic_path(tmp_path / "absent" / "a.h5"):
        pass
    with pytest.raises(InputError, match="is a folder"), atomic_path(tmp_path):
        pass


@given(content=st.binary(max_size=100), repeats=st.sampled_from([1, 30_000]))
def test_sha256_of_file_is_that_of_its_bytes(
    tmp_path_factory: pytest.TempPathFactory, content: bytes, repeats: int
) -> None:
    file = tmp_path_factory.mktemp("sha") / "file"
    file.write_bytes(content * repeats)
    assert sha256_of_file(file) == hashlib.sha256(content * repeats).hexdigest()
