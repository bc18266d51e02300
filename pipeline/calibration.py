"""A profilometer's calibration, and the file that keeps it."""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from greenough.instrument import hdf5
from greenough.instrument.contract import Procedure, RigIdentity, SpotBoard
from greenough.instrument.errors import InputError

from .camera_model import CameraModel
from .fringes import FringeSet
from .phase_height import PhaseHeight

KIND = "greenough calibration"
VERSION = 1

_PHASE_HEIGHT_UNITS = {
    "coefficients": "m1 mm, m0 mm, n1 1, r3 mm^-2",
    "phase_centre": "rad",
    "phase_half_range": "rad",
    "z_range": "mm",
    "valid": "1",
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
        document = {
            "camera": asdict(self.camera),
            "identity": asdict(self.identity),
            "board": asdict(self.board),
            "procedure": asdict(self.procedure),
            "run": self.run,
            "exposures": self.exposures,
            "figures": dict(self.figures),
        }
        with hdf5.create(path, KIND, VERSION) as file:
            hdf5.put(file, "document", json.dumps(document), "UTF-8 JSON")
            hdf5.put(file, "camera_from_world", self.camera_from_world, "1, translation mm")
            for name, units in _PHASE_HEIGHT_UNITS.items():
                hdf5.put(file, f"phase_height/{name}", getattr(self.phase_height, name), units)

    @classmethod
    def load(cls, path: str | Path) -> "Calibration":
        """Read a calibration file.

        Raises
        ------
        InputError
            If the file is missing, truncated, damaged, foreign, or of another version.
        """
        with hdf5.read(path, KIND, VERSION) as file:
            document = json.loads(hdf5.get_text(file, "document"), object_hook=_with_tuples)
            return cls(
                camera=CameraModel(**document["camera"]),
                camera_from_world=hdf5.get(file, "camera_from_world"),
                phase_height=PhaseHeight(
                    **{name: hdf5.get(file, f"phase_height/{name}") for name in _PHASE_HEIGHT_UNITS}
                ),
                identity=RigIdentity(**document["identity"]),
                board=SpotBoard(**document["board"]),
                procedure=Procedure(**document["procedure"]),
                run=document["run"],
                exposures=document["exposures"],
                figures=document["figures"],
            )


def _with_tuples(entries: dict[str, Any]) -> dict[str, Any]:
    """JSON has lists only; the dataclasses hold tuples."""

    def frozen(value: Any) -> Any:
        return tuple(frozen(item) for item in value) if isinstance(value, list) else value

    return {name: frozen(value) for name, value in entries.items()}


def _size(shape: tuple[int, ...]) -> str:
    return " x ".join(str(n) for n in reversed(shape))
