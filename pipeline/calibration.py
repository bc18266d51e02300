"""A profilometer's calibration, and the file that keeps it."""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from greenough.instrument import hdf5
from greenough.instrument.contract import KnownUncertainty, Procedure, RigIdentity, SpotBoard
from greenough.instrument.errors import InputError

from .calibration_uncertainty import CalibrationUncertainty
from .camera_model import CameraModel
from .fringes import FringeSet
from .imaging_path import ImagingPath
from .instrument_model import InstrumentModel
from .legendre_field import DepthField
from .method import Method
from .path_drift import along_ray_per_shift, walked_mm
from .phase_height import PhaseHeight
from .point_kernel import PointKernel
from .point_spread import PointSpread
from .projector_model import ProjectorModel
from .rays import Rays

KIND = "greenough calibration"
VERSION = 3

_ARRAYS = {
    "rays": {"origin": "mm", "slope": "1"},
    "phase_height": {
        "coefficients": "m1 mm, m0 mm, n1 1, r3 mm^-2",
        "phase_centre": "rad",
        "phase_half_range": "rad",
        "z_range": "mm",
        "valid": "1",
    },
    "residuals": {
        "centres_px": "px",
        "spots_px": "px",
        "spot_phases_rad": "rad",
        "planes_um": "um",
        "pixels_um": "um",
    },
    "uncertainty": {
        "heights_mm": "mm",
        "grid_v_px": "px",
        "grid_u_px": "px",
        "modes_mm": "mm",
        "pattern_sd_mm": "mm",
    },
}
"""Parts of a calibration that are arrays, with the units that the file states."""


@dataclass(frozen=True, eq=False)
class Residuals:
    """What a calibration's own data depart from it, measured minus fitted; NaN where nothing was measured.

    Parameters
    ----------
    centres_px : (postures, spots, 2) float64
        Where the spots' centres were found.
    spots_px : (postures, spots, 2) float64
        Of the spots' centres.
    spot_phases_rad : (postures, spots) float64
        Of the phases at the spots; all NaN for the paper's method, which does not use them.
    planes_um : (planes, grid rows, grid cols) float32
        Of the planes' heights, means over blocks of the picture; no planes for methods without.
    pixels_um : (rows, cols) float32
        Of the planes' heights, root mean square over the planes; all NaN for methods without.
    """

    centres_px: np.ndarray
    spots_px: np.ndarray
    spot_phases_rad: np.ndarray
    planes_um: np.ndarray
    pixels_um: np.ndarray


@dataclass(frozen=True)
class Calibration:
    """Everything that turns phase into points, and whose it is.

    Parameters
    ----------
    method : Method
        The paper's takes the stage's readings for heights and fits a relation to every pixel. The others fit one smooth
        model and believe the board: the bundle to postures and planes, the stage-free one to postures alone, and plain
        triangulation two pinholes with distortion to spots at their nominal places.
    camera : CameraModel
        The pinhole with distortion. Points come from ``rays``, which hold the bundle's residual field, too.
    camera_from_world : (4, 4) float64
        The world frame is the board's as it lay flat: z = 0 through its printed face, z up.
    rays : Rays
        Where each pixel looks.
    phase_height : PhaseHeight
        How high on its ray a pixel's phase is.
    identity : RigIdentity
        The instrument that was calibrated.
    board : SpotBoard
        The board that set the scale.
    procedure : Procedure
        How it was calibrated; measurements use the same fringes.
    known : KnownUncertainty
        What the rig stated of errors that no calibration shows.
    run : str
        Name of the run whose exposures went in.
    exposures : int
        How many exposures of that run were taken.
    figures : mapping
        What the fits say about themselves, by name with the unit in the name.
    residuals : Residuals
    uncertainty : CalibrationUncertainty
        How far it may displace the points that are measured with it.
    instrument : InstrumentModel or None
        The global model with its parameters' covariance; the paper's method has none.
    point_spread : PointSpread or None
        Of the camera; None where the spots were too few to tell.
    """

    method: Method
    camera: CameraModel
    camera_from_world: np.ndarray
    rays: Rays
    phase_height: PhaseHeight
    identity: RigIdentity
    board: SpotBoard
    procedure: Procedure
    known: KnownUncertainty
    run: str
    exposures: int
    figures: Mapping[str, Any]
    residuals: Residuals
    uncertainty: CalibrationUncertainty
    instrument: InstrumentModel | None = None
    point_spread: PointSpread | None = None

    def _repr_html_(self) -> str:
        from .notebook import calibration_html

        return calibration_html(self)

    @property
    def fringes(self) -> FringeSet:
        """The fringes that the phases belong to."""
        return FringeSet.of(self.procedure)

    def uncertainty_after(self, exposures: int) -> CalibrationUncertainty:
        """What calibration and drifts may do to points of a run that has taken so many exposures.

        The table's drift within the run moves the part itself, which is measured where it is.
        """
        return self.uncertainty if exposures == 0 else self.uncertainty.joined(self.path_drift(exposures)[None])

    def path_drift(self, exposures: int) -> np.ndarray:
        """What the path's drift over so many exposures moves points by, (3,) mm: one standard deviation."""
        return walked_mm(self.known, self.procedure, exposures) * self._along_ray_per_shift

    @cached_property
    def point_kernel(self) -> PointKernel:
        """What `reconstruct` computes points with; heights beyond the planes are believed by half a plane step.

        It is made when it is first asked for, from ``phase_height`` and ``rays`` as they are then, and kept.
        """
        return PointKernel.of(self.phase_height, self.rays, self.procedure.plane_step_mm / 2)

    @cached_property
    def _along_ray_per_shift(self) -> np.ndarray:
        return along_ray_per_shift(self.rays, self.phase_height)

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
            "method": self.method,
            "camera": asdict(self.camera),
            "identity": asdict(self.identity),
            "board": asdict(self.board),
            "procedure": asdict(self.procedure),
            "known": asdict(self.known),
            "run": self.run,
            "exposures": self.exposures,
            "figures": dict(self.figures),
            "point_spread": None if self.point_spread is None else asdict(self.point_spread),
        }
        with hdf5.create(path, KIND, VERSION) as file:
            hdf5.put(file, "document", json.dumps(document), "UTF-8 JSON")
            hdf5.put(file, "camera_from_world", self.camera_from_world, "1, translation mm")
            for group, units in _ARRAYS.items():
                for name, unit in units.items():
                    hdf5.put(file, f"{group}/{name}", getattr(getattr(self, group), name), unit)
            if self.instrument is not None:
                _put_instrument(file, self.instrument)

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
            camera, camera_from_world = CameraModel(**document["camera"]), hdf5.get(file, "camera_from_world")
            spread = document["point_spread"]

            def arrays(group: str) -> dict[str, np.ndarray]:
                return {name: hdf5.get(file, f"{group}/{name}") for name in _ARRAYS[group]}

            return cls(
                method=document["method"],
                camera=camera,
                camera_from_world=camera_from_world,
                rays=Rays(**arrays("rays")),
                phase_height=PhaseHeight(**arrays("phase_height")),
                identity=RigIdentity(**document["identity"]),
                board=SpotBoard(**document["board"]),
                procedure=Procedure(**document["procedure"]),
                known=KnownUncertainty(**document["known"]),
                run=document["run"],
                exposures=document["exposures"],
                figures=document["figures"],
                residuals=Residuals(**arrays("residuals")),
                uncertainty=CalibrationUncertainty(**arrays("uncertainty")),
                instrument=_get_instrument(file, camera, camera_from_world) if "instrument" in file else None,
                point_spread=None if spread is None else PointSpread(**spread),
            )


def _put_instrument(file: h5py.File, instrument: InstrumentModel) -> None:
    """The bundle's model; its camera and pose are the calibration's."""
    camera, projector = instrument.camera, instrument.projector
    fields = {"camera": asdict(camera.field), "projector": asdict(projector.field)}
    hdf5.put(file, "instrument/fields", json.dumps(fields), "UTF-8 JSON")
    hdf5.put(file, "instrument/camera_coefficients", camera.coefficients, "px")
    hdf5.put(file, "instrument/projector_row", projector.row, "a0 rad, a rad/mm, b 1/mm")
    hdf5.put(file, "instrument/projector_coefficients", projector.coefficients, "rad")
    hdf5.put(file, "instrument/covariance", instrument.covariance, "pose rad mm, camera px, projector rad; squared")


def _get_instrument(file: h5py.File, camera: CameraModel, camera_from_world: np.ndarray) -> InstrumentModel:
    fields = json.loads(hdf5.get_text(file, "instrument/fields"), object_hook=_with_tuples)
    coefficients = {path: hdf5.get(file, f"instrument/{path}_coefficients") for path in ("camera", "projector")}
    return InstrumentModel(
        ImagingPath(camera, camera_from_world, DepthField(**fields["camera"]), coefficients["camera"]),
        ProjectorModel(
            hdf5.get(file, "instrument/projector_row"), DepthField(**fields["projector"]), coefficients["projector"]
        ),
        hdf5.get(file, "instrument/covariance"),
    )


def _with_tuples(entries: dict[str, Any]) -> dict[str, Any]:
    """JSON has lists only; the dataclasses hold tuples."""

    def frozen(value: Any) -> Any:
        return tuple(frozen(item) for item in value) if isinstance(value, list) else value

    return {name: frozen(value) for name, value in entries.items()}


def _size(shape: tuple[int, ...]) -> str:
    return " x ".join(str(n) for n in reversed(shape))
