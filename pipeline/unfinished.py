"""A calibration under way: one file per finished step, so that an interrupted run goes on where it stopped."""

import json
import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from greenough.instrument import hdf5
from greenough.instrument.contract import Rig
from greenough.instrument.errors import FileError, InputError
from greenough.instrument.file_errors import reading
from greenough.instrument.files import atomic_path, check_folder, make_folder

KIND = "greenough calibration step"
VERSION = 3

_MANIFEST = "manifest.json"
_STACK = "stack"
_MEANING = {
    "rig": "another rig",
    "settings": "other settings of the rig (its file, its --set options or its seed)",
    "board": "another board",
    "procedure": "another procedure",
    "run": "another run (--run)",
    "version": "another version of this program",
}


@dataclass(frozen=True)
class Step:
    """A finished step: what it found, and the state that the next step starts from.

    Parameters
    ----------
    arrays : mapping of str to array
    exposure_us : float
        The camera's setting when the step ended.
    exposures : int
        Exposures that the run had taken when the step ended.
    """

    arrays: Mapping[str, np.ndarray]
    exposure_us: float
    exposures: int


@dataclass(frozen=True)
class Unfinished:
    """The folder ``OUT.partial`` beside the calibration ``OUT`` that is being made."""

    folder: Path

    @classmethod
    def beside(cls, out: str | Path) -> "Unfinished":
        """The folder that belongs to an output file, whether or not it exists."""
        return cls(Path(f"{out}.partial"))

    def begin(self, rig: Rig, run: str) -> None:
        """Create the folder for this rig and run, or make sure that it was made for the same.

        Raises
        ------
        InputError
            If the folder belongs to another rig, settings, board, procedure, run or version, or cannot be created.
        """
        wanted = _manifest(rig, run)
        path = self.folder / _MANIFEST
        if not path.exists():
            make_folder(self.folder)
            try:
                with atomic_path(path) as temporary:
                    temporary.write_text(json.dumps(wanted, indent=2))
            finally:
                if not path.exists():
                    with suppress(OSError):  # where others keep something in it
                        self.folder.rmdir()
            return
        check_folder(self.folder)
        with reading(path):
            text = path.read_bytes()
        try:
            found = json.loads(text)
            differing = [name for name in wanted if found.get(name) != wanted[name]]
        except (ValueError, AttributeError):
            raise InputError(f"{path} is damaged: delete the folder {self.folder} to start anew") from None
        if differing:
            reasons = " and ".join(_MEANING[name] for name in differing)
            raise InputError(
                f"the unfinished calibration {self.folder} was made with {reasons}: go on with what it was started "
                "with, or delete the folder to start anew"
            )

    @property
    def holds_steps(self) -> bool:
        """Whether any step is finished."""
        return any(self.folder.glob("*.h5"))

    @property
    def exposures(self) -> int:
        """Exposures that the run had taken when its last finished step ended: what the rig must count on from."""
        return max((self._read_state(path)[1] for path in self.folder.glob("*.h5")), default=0)

    def step(self, name: str) -> Step | None:
        """A finished step, or None."""
        path = self._path(name)
        if not path.exists():
            return None
        exposure_us, exposures = self._read_state(path)
        with hdf5.read(path, KIND, VERSION) as file:
            arrays = file["arrays"]
            assert isinstance(arrays, h5py.Group)
            return Step({str(key): hdf5.get(file, f"arrays/{key}") for key in arrays}, exposure_us, exposures)

    def finish(self, name: str, step: Step) -> None:
        """Keep a finished step; its file appears whole or not at all.

        Raises
        ------
        FileError
            When it cannot be written.
        """
        with hdf5.create(self._path(name), KIND, VERSION) as file:
            hdf5.put(file, "exposure_us", np.array(step.exposure_us), "us")
            hdf5.put(file, "exposures", np.array(step.exposures), "1")
            file.create_group("arrays")
            for key, values in step.arrays.items():
                hdf5.put(file, f"arrays/{key}", values, _units(key))

    @contextmanager
    def stacked(self, names: Sequence[str], key: str) -> Iterator[h5py.Dataset]:
        """The arrays ``key`` of several finished steps as one, (steps, ...), while the body runs.

        Nothing is copied: what is asked for is read from the steps' files, so that memory does not grow with them.
        """
        first = self.step(names[0])
        assert first is not None
        one = first.arrays[key]
        layout = h5py.VirtualLayout((len(names), *one.shape), one.dtype)
        for k, name in enumerate(names):
            layout[k] = h5py.VirtualSource(self._path(name).name, f"arrays/{key}", one.shape)  # beside the stack's file
        path = self.folder / _STACK
        with hdf5.create(path, _STACK, VERSION) as file:
            file.create_virtual_dataset(key, layout, fillvalue=np.nan)
        with hdf5.read(path, _STACK, VERSION) as file:
            stack = file[key]
            assert isinstance(stack, h5py.Dataset)
            yield stack

    @contextmanager
    def repeated_on_refusal(self, names: Iterable[str]) -> Iterator[None]:
        """Drop these steps if the body refuses them by an InputError, so that the next call does them again."""
        try:
            yield
        except FileError:  # which says nothing about the steps
            raise
        except InputError:
            for name in names:
                self._path(name).unlink(missing_ok=True)
            raise

    def remove(self) -> None:
        """The calibration is written: nothing of this is needed any more."""
        shutil.rmtree(self.folder)

    def _path(self, name: str) -> Path:
        return self.folder / f"{name}.h5"

    def _read_state(self, path: Path) -> tuple[float, int]:
        with hdf5.read(path, KIND, VERSION) as file:
            return float(hdf5.get(file, "exposure_us")), int(hdf5.get(file, "exposures"))


def _manifest(rig: Rig, run: str) -> dict[str, Any]:
    identity = asdict(rig.identity)
    manifest = {
        "settings": identity.pop("settings_sha256"),
        "rig": identity,
        "board": asdict(rig.board),
        "procedure": asdict(rig.procedure),
        "run": run,
        "version": version("greenough"),
    }
    return json.loads(json.dumps(manifest))


def _units(key: str) -> str:
    """By the name's ending, as everywhere."""
    return next((unit for unit in ("px", "mm", "rad") if key.endswith(f"_{unit}")), "1")
