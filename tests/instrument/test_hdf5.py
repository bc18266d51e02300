from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from greenough.instrument import hdf5
from greenough.instrument.errors import InputError


def written(path: Path) -> Path:
    with hdf5.create(path, "test file", 3) as file:
        hdf5.put(file, "deep/values", np.arange(12.0).reshape(3, 4), units="mm")
        hdf5.put(file, "note", "Größe", units="UTF-8")
    return path


@given(
    values=hnp.arrays(
        st.sampled_from([np.uint8, np.uint16, np.int64, np.float32, np.float64, np.bool_]),
        hnp.array_shapes(min_dims=0, max_dims=3, min_side=0),
    )
)
def test_an_array_comes_back_bit_by_bit(tmp_path_factory: pytest.TempPathFactory, values: np.ndarray) -> None:
    path = tmp_path_factory.mktemp("hdf5") / "a.h5"
    with hdf5.create(path, "test file", 1) as file:
        hdf5.put(file, "values", values, units="1")
    with hdf5.read(path, "test file", 1) as file:
        found = hdf5.get(file, "values")
    assert found.dtype == values.dtype
    assert found.shape == values.shape
    assert found.tobytes() == values.tobytes()


def test_text_and_units_come_back(tmp_path: Path) -> None:
    with hdf5.read(written(tmp_path / "a.h5"), "test file", 3) as file:
        assert hdf5.get_text(file, "note") == "Größe"
        assert file["deep/values"].attrs["units"] == b"mm"


@pytest.mark.parametrize("change", ["value", "units", "checksum", "removed"])
def test_any_change_is_noticed(tmp_path: Path, change: str) -> None:
    path = written(tmp_path / "a.h5")
    with h5py.File(path, "r+") as file:
        dataset: Any = file["deep/values"]
        if change == "value":
            dataset[1, 2] = np.nextafter(dataset[1, 2], 100)
        elif change == "units":
            dataset.attrs["units"] = np.bytes_("um")
        elif change == "checksum":
            del dataset.attrs["sha256"]
        else:
            del file["deep/values"]
    with hdf5.read(path, "test file", 3) as file, pytest.raises(InputError, match=r"a\.h5 is damaged: .*deep/values"):
        hdf5.get(file, "deep/values")


def test_other_files_are_refused_with_what_they_are(tmp_path: Path) -> None:
    path = written(tmp_path / "a.h5")
    text = tmp_path / "text.h5"
    text.write_text("not HDF5")
    foreign = tmp_path / "foreign.h5"
    with h5py.File(foreign, "w") as file:
        file["data"] = 1
    cases = [
        (tmp_path / "absent.h5", "test file", 3, "there is no test file"),
        (tmp_path, "test file", 3, "it is a folder; name a file"),
        (text, "test file", 3, "it is not HDF5"),
        (foreign, "test file", 3, "is not a test file$"),
        (path, "calibration", 3, "is not a calibration but a test file"),
        (path, "test file", 2, "of version 3; this program reads version 2"),
    ]
    for candidate, kind, version, expected in cases:
        with pytest.raises(InputError, match=expected), hdf5.read(candidate, kind, version):
            pass


def test_a_truncated_file_is_refused(tmp_path: Path) -> None:
    path = written(tmp_path / "a.h5")
    whole = path.read_bytes()
    for share in (0.1, 0.5, 0.99):
        path.write_bytes(whole[: int(share * len(whole))])
        with pytest.raises(InputError, match="truncated or damaged"), hdf5.read(path, "test file", 3):
            pass


def test_an_exception_while_writing_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt), hdf5.create(tmp_path / "a.h5", "test file", 1) as file:
        raise KeyboardInterrupt(hdf5.put(file, "half", np.zeros(3), units="1"))
    assert list(tmp_path.iterdir()) == []
