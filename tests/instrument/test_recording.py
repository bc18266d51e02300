import tracemalloc
from pathlib import Path

import h5py
import numpy as np
import pytest

from greenough.instrument.contract import Frames, Placement
from greenough.instrument.errors import InputError
from greenough.instrument.recording import record


def test_a_recording_names_its_units_and_carries_checksums(tmp_path: Path, fake_rig, patterns) -> None:
    with record(fake_rig(), tmp_path / "rig.h5") as rig:
        rig.capture(patterns)
    with h5py.File(tmp_path / "rig.h5") as file:
        assert file["captures/000000/stack"].attrs["units"] == b"DN"
        assert file["captures/000000/times_s"].attrs["units"] == b"s"
        found = []
        file.visititems(lambda name, item: found.append(item) if isinstance(item, h5py.Dataset) else None)
        assert len(found) == 5
        for dataset in found:
            assert len(bytes.fromhex(dataset.attrs["sha256"].decode())) == 32


def test_nothing_is_at_the_path_before_the_clean_end(tmp_path: Path, fake_rig, patterns) -> None:
    path = tmp_path / "rig.h5"
    with record(fake_rig(), path) as rig:
        rig.capture(patterns)
        assert not path.exists()
    assert [file.name for file in tmp_path.iterdir()] == ["rig.h5"]


@pytest.mark.parametrize("error", [InputError, KeyboardInterrupt])
def test_an_exception_leaves_no_file_and_a_safe_rig(tmp_path: Path, fake_rig, patterns, error) -> None:
    rig = fake_rig()

    def fail() -> None:
        with record(rig, tmp_path / "rig.h5") as recorded:
            recorded.capture(patterns)
            assert rig.entered
            raise error

    with pytest.raises(error):
        fail()
    assert not rig.entered
    assert list(tmp_path.iterdir()) == []


def test_a_path_that_cannot_be_written_is_refused_before_the_rig_is_touched(tmp_path: Path, fake_rig) -> None:
    rig = fake_rig()
    with pytest.raises(InputError, match=r"must end in \.h5"):
        record(rig, tmp_path / "rig.toml")
    with pytest.raises(InputError, match="no folder"):
        record(rig, tmp_path / "absent" / "rig.h5").__enter__()
    assert not rig.entered


def test_a_recorded_rig_is_used_inside_its_context_only(tmp_path: Path, fake_rig) -> None:
    with pytest.raises(RuntimeError, match="inside its context"):
        record(fake_rig(), tmp_path / "rig.h5").stage.move_to_mm(0.0)


def test_memory_does_not_grow_with_the_number_of_captures(tmp_path: Path, fake_rig, patterns) -> None:
    size = 2 << 20

    class Large(fake_rig):
        def capture(self, patterns: np.ndarray) -> Frames:
            frames = super().capture(patterns)
            stack = np.full((1, 1024, size // 1024), 7, np.uint8)
            return Frames(**{**vars(frames), "stack": stack})

    with record(Large(), tmp_path / "rig.h5") as rig:
        rig.operator.place(Placement("board"))
        tracemalloc.start()
        for _ in range(12):
            rig.capture(patterns)
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
    assert (tmp_path / "rig.h5").stat().st_size > 12 * size
    assert peak < 3 * size
