import h5py
import numpy as np

from greenough.pipeline.unfinished import Step, Unfinished


def test_steps_are_read_together_from_their_files(tmp_path):
    """Under a name with a per cent sign, which HDF5 would otherwise take for a pattern."""
    unfinished = Unfinished(tmp_path / "50%b.h5.partial")
    unfinished.folder.mkdir()
    maps = np.random.default_rng(1).normal(size=(5, 12, 16)).astype(np.float32)
    names = [f"plane-{k:02d}" for k in range(len(maps))]
    for k, (name, each) in enumerate(zip(names, maps, strict=True)):
        unfinished.finish(name, Step({"phase_rad": each}, 1000.0, 24 * (k + 1)))
    with unfinished.stacked(names[1:], "phase_rad") as stack:
        assert isinstance(stack, h5py.Dataset)
        assert stack.dtype == np.float32
        assert np.array_equal(stack, maps[1:])
        assert np.array_equal(stack[:, 3:7], maps[1:, 3:7])
        assert np.array_equal(stack[2], maps[3])
    assert unfinished.exposures == 24 * len(maps)
    with unfinished.stacked(names, "phase_rad") as stack:
        assert np.array_equal(stack, maps)
