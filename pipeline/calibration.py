"""A profilometer's calibration, and the file that keeps it."""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from greenough.instrument.contract import Procedure, RigIdentity, SpotBoard
from greenough.instrument.errors import InputError
from greenough.instrument.files import atomic_path

from .camera_model import CameraModel
from .fringes import FringeSet
from .phase_height import PhaseHeight

SCHEMA = "greenough calibration"
SCHEMA_VERSION = 1

_UNITS = {
    "camera_from_world": "mm (translation)",
    "phase_height/coefficients": "m1 mm, m0 mm, n1 1, r3 mm^-2",
    "phase_height/phase_centre": "rad",
    "phase_height/phase_half_range": "rad",
    "phase_height/z_range": "mm",
    "phase_height/valid": "",
}


@dataclass(frozen=True)
class Calibration:
    """Everything that turns phase into points, and whose it is.

    Parameters
    ----------
    camera : CameraModel
    camera_from_world : (4, 4) float64
        The world frame is the board's as it lay flat: z = 0 through its printed face, z up.
    phase_height : PhaseHeight
    identity : RigIdentity
        The instrument that was calibrated.
    board : SpotBoard
        The board that set the scale.
    procedure : Procedure
        How it was calibrated; measurements use the same fringes.
    run : str
        Name of the run whose exposures went in.
    exposures : int
        How many exposures of that run were taken.
    figures : mapping
        What the fits say about themselves, by name with the unit in the name.
    """

    camera: CameraModel
    camera_from_world: np.ndarray
    phase_height: PhaseHeight
    identity: RigIdentity
    board: SpotBoard
    procedure: Procedure
    run: str
    exposures: int
    figures: Mapping[str, Any]

    @property
    def fringes(self) -> FringeSet:
        """The fringes that the phases belong to."""
        return FringeSet(self.procedure.periods_px, self.procedure.steps)

    def check_shape(self, shape: tuple[int, ...]) -> None:
        """Raise InputError if ``shape`` is not the calibrated camera's (rows, cols)."""
        if tuple(shape) != tuple(self.camera.shape):
            raise InputError(
                f"the calibration is for a camera of {_size(self.camera.shape)} pixels, the picture has "
                f"{_size(shape)}: calibrate this camera"
            )

    def check_fits(self, identity: RigIdentity, shape: tuple[int, int]) -> None:
        """Raise InputError if the calibration was made with another instrument or camera size.

        The devices decide (name and serial numbers); settings may differ between calibrating and measuring.
        """
        self.check_shape(shape)
        for what in ("name", "camera_serial", "projector_serial"):
            theirs, ours = getattr(identity, what), getattr(self.identity, what)
            if theirs != ours:
                raise InputError(
                    f"the calibration was made with another rig: its {what.replace('_', ' ')} is {ours!r}, "
                    f"this rig's is {theirs!r}; calibrate this rig"
                )

    def save(self, path: str | Path) -> None:
        """Write an HDF5 file: arrays with their units and checksums, the rest as one JSON document.

        The file appears whole or not at all.
        """
        relation = self.phase_height
        arrays = {
            "camera_from_world": np.asarray(self.camera_from_world, dtype=np.float64),
            "phase_height/coefficients": relation.coefficients,
            "phase_height/phase_centre": relation.phase_centre,
            "phase_height/phase_half_range": relation.phase_half_range,
            "phase_height/z_range": relation.z_range,
            "phase_height/valid": relation.valid,
        }
        document = json.dumps(
            {
                "camera": asdict(self.camera),
                "identity": asdict(self.identity),
                "board": asdict(self.board),
                "procedure": asdict(self.procedure),
                "run": self.run,
                "exposures": self.exposures,
                "figures": dict(self.figures),
            }
        )
        with atomic_path(path) as temporary, h5py.File(temporary, "w") as file:
            file.attrs["schema"] = SCHEMA
            file.attrs["schema_version"] = SCHEMA_VERSION
            file.attrs["document"] = document
            file.attrs["document_sha256"] = _sha256(document.encode())
            for name, array in arrays.items():
                dataset = file.create_dataset(name, data=array)
                dataset.attrs["unit"] = _UNITS[name]
                dataset.attrs["sha256"] = _sha256(np.ascontiguousarray(array).data)

    @classmethod
    def load(cls, path: str | Path) -> "Calibration":
        """Read a calibration file.

        Raises
        ------
        InputError
            If the file is missing, truncated, damaged, foreign, or of another schema version.
        """
        path = Path(path)
        if not path.is_file():
            raise InputError(f"there is no calibration file {path}: make one with `greenough calibrate`")
        try:
            with h5py.File(path, "r") as file:
                return cls._read(file, path)
        except (OSError, KeyError, TypeError, RuntimeError, json.JSONDecodeError) as error:
            raise InputError(
                f"the calibration file {path} is damaged or truncated ({error}): calibrate again"
            ) from None

    @classmethod
    def _read(cls, file: h5py.File, path: Path) -> "Calibration":
        if file.attrs.get("schema") != SCHEMA:
            raise InputError(f"{path} is an HDF5 file, but no calibration: name a file of `greenough calibrate`")
        version = int(file.attrs["schema_version"])
        if version != SCHEMA_VERSION:
            raise InputError(
                f"the calibration file {path} has schema version {version}, this program reads {SCHEMA_VERSION}: "
                "calibrate again"
            )
        text = str(file.attrs["document"])
        if _sha256(text.encode()) != file.attrs["document_sha256"]:
            raise InputError(f"the calibration file {path} is damaged (document): calibrate again")
        arrays = {}
        for name in _UNITS:
            arrays[name] = array = file[name][()]
            if _sha256(np.ascontiguousarray(array).data) != file[name].attrs["sha256"]:
                raise InputError(f"the calibration file {path} is damaged ({name}): calibrate again")
        document = json.loads(text)
        camera = document["camera"] | {"shape": tuple(document["camera"]["shape"])}
        board = document["board"] | {"big": tuple(tuple(index) for index in document["board"]["big"])}
        procedure = {
            name: tuple(value) if isinstance(value, list) else value for name, value in document["procedure"].items()
        }
        return cls(
            camera=CameraModel(**camera),
            camera_from_world=arrays["camera_from_world"],
            phase_height=PhaseHeight(
                coefficients=arrays["phase_height/coefficients"],
                phase_centre=arrays["phase_height/phase_centre"],
                phase_half_range=arrays["phase_height/phase_half_range"],
                z_range=arrays["phase_height/z_range"],
                valid=arrays["phase_height/valid"],
            ),
            identity=RigIdentity(**document["identity"]),
            board=SpotBoard(**board),
            procedure=Procedure(**procedure),
            run=document["run"],
            exposures=document["exposures"],
            figures=document["figures"],
        )


def _sha256(data: bytes | memoryview) -> str:
    return hashlib.sha256(data).hexdigest()


def _size(shape: tuple[int, ...]) -> str:
    return " x ".join(str(n) for n in reversed(shape))
