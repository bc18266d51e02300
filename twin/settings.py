"""The ``[twin]`` section of a rig file: every physical effect and its default; ``docs/physics.md`` has what they do."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Self

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, model_validator

from greenough.instrument.errors import InputError
from greenough.instrument.rigfile import RigFile, describe_validation_error, load_rig_file

_STRICT = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


def _power_of_two(value: int) -> int:
    if value & (value - 1):
        raise ValueError(f"must be a power of two, not {value}")
    return value


Nodes = Annotated[int, Field(ge=2, le=65536), AfterValidator(_power_of_two)]
Size = Annotated[float, Field(ge=0, le=1e4)]


class OpticsSettings(BaseModel):
    """Two off-axis lens paths; all lengths are at the specimen.

    Through ``glass`` the prescriptions of ``greenough.twin.glass`` decide on pupils, focus and aperture.
    """

    model_config = _STRICT
    glass: bool = True  # false: ideal lenses, whose paths stand where they should
    na: Annotated[float, Field(gt=0, le=0.019)] = 0.015  # above, the mirrors' lattice itself would be projected
    wavelength_um: Annotated[float, Field(gt=0.2, lt=2)] = 0.525
    convergence_deg: Annotated[float, Field(gt=1, lt=60)] = 12.0
    pupil_distance_mm: Annotated[float, Field(gt=10, lt=2000)] = 224.56
    camera_focal_px: Annotated[float, Field(gt=100, lt=1e6)] = 22683.0
    column_pitch_um: Annotated[float, Field(gt=1, lt=1000)] = 17.835
    row_pitch_um: Annotated[float, Field(gt=1, lt=1000)] = 8.923
    finite_aperture: bool = True  # false: pinholes, no defocus
    camera_diffraction: bool = True
    mirror_fill: Annotated[float, Field(gt=0.1, le=1)] = 0.92
    off_state: Annotated[float, Field(ge=0, lt=0.5)] = 0.001
    gamma: Annotated[float, Field(ge=0.2, le=5)] = 1.0  # of the mirrors' light over the grey values; 1 is linear

    @model_validator(mode="after")
    def _glass_decides(self) -> Self:
        for name in ("na", "pupil_distance_mm"):
            if self.glass and getattr(self, name) != type(self).model_fields[name].default:
                raise ValueError(f"{name} is that of the glass; set twin.optics.glass=false to choose it")
        return self


class AssemblySettings(BaseModel):
    """Standard deviations per axis of how the paths in glass were put together, see ``glass.as_built.Tolerances``."""

    model_config = _STRICT
    decentre_um: Annotated[float, Field(ge=0, le=300)] = 30.0
    tilt_deg: Annotated[float, Field(ge=0, le=1)] = 0.05
    image_tilt_deg: Annotated[float, Field(ge=0, le=5)] = 0.3
    focus_um: Annotated[float, Field(ge=0, le=1000)] = 100.0
    axis_deg: Annotated[float, Field(ge=0, le=2)] = 0.2
    pointing_um: Annotated[float, Field(ge=0, le=500)] = 50.0


class LightSettings(BaseModel):
    """Photons per ms that a white Lambertian surface sends onto a pixel in the middle of the field.

    ``ambient`` is light that every pixel gets besides, as a share of that: 0.5 % of full scale where white has 80 %.
    """

    model_config = _STRICT
    white_photons_per_ms: Annotated[float, Field(gt=0, le=1e6)] = 150.0
    ambient: Annotated[float, Field(ge=0, le=1)] = 0.00625
    bandwidth_um: Annotated[float, Field(ge=0, le=0.1)] = 0.030  # full width at half maximum; glass alone sees it


class CameraSettings(BaseModel):
    """EMVA 1288 as the camera really is; ``shot_noise`` and the sizes can be switched off one by one."""

    model_config = _STRICT
    quantum_efficiency: Annotated[float, Field(gt=0, le=1)] = 0.5  # electrons per photon
    shot_noise: bool = True
    read_noise_e: Size = 10.0
    prnu: Annotated[float, Field(ge=0, le=0.2)] = 0.01
    dsnu_e: Size = 3.0


class StageSettings(BaseModel):
    """Standard deviations over the travel; the axis is fixed against the table."""

    model_config = _STRICT
    position_sd_um: Size = 3.3
    straightness_sd_um: Size = 2.0
    pitch_roll_sd_urad: Size = 100.0
    axis_sd_deg: Annotated[float, Field(ge=0, le=5)] = 0.2


class StabilitySettings(BaseModel):
    """Standard deviations: of each frame for flicker (relative) and vibration, after a calibration for the drifts."""

    model_config = _STRICT
    flicker: Annotated[float, Field(ge=0, le=0.1)] = 0.001
    vibration_um: Annotated[float, Field(ge=0, le=10)] = 0.1
    table_drift_um: Annotated[float, Field(ge=0, le=100)] = 0.5
    path_drift_um: Annotated[float, Field(ge=0, le=10)] = 0.05


class BoardSettings(BaseModel):
    """How well the calibration board and the second board are made, see ``greenough.scenes.board.BoardErrors``.

    ``scale_error_ppm`` is a known error of the calibration board alone, against the drawing that the rig file states.
    """

    model_config = _STRICT
    print_sd_um: Size = 0.6
    scale_sd_ppm: Size = 30.0
    scale_error_ppm: Annotated[float, Field(ge=-5e4, le=5e4)] = 0.0
    bow_sd_um: Size = 2.0
    wedge_sd_urad: Size = 50.0
    ink_thickness_um: Size = 1.0


class RenderSettings(BaseModel):
    """Light paths per pixel: of specimens with relief, of the edges on boards, and for interreflections.

    Planes, and boards away from edges, have 16. See ``twin.node_design`` for the numbers that are designed.
    """

    model_config = _STRICT
    nodes: Nodes = 32
    nodes_edges: Nodes = 128
    nodes_indirect: Nodes = 16
    smoothing_px: Annotated[int, Field(ge=0, le=16)] = 4  # of interreflections along smooth surfaces; 0 is unbiased
    bounces: Annotated[int, Field(ge=1, le=8)] = 2  # surface interactions of a path: 1 has no interreflection
    diffuse_only: bool = False  # every material as a Lambertian one of the same reflectance


class TwinSettings(BaseModel):
    """All of ``[twin]``. ``seed`` draws the instrument: its errors, its boards and its postures."""

    model_config = _STRICT
    seed: Annotated[int, Field(ge=0, le=2**32 - 1)] = 1
    optics: OpticsSettings = OpticsSettings()
    assembly: AssemblySettings = AssemblySettings()
    light: LightSettings = LightSettings()
    camera: CameraSettings = CameraSettings()
    stage: StageSettings = StageSettings()
    stability: StabilitySettings = StabilitySettings()
    board: BoardSettings = BoardSettings()
    render: RenderSettings = RenderSettings()


def twin_settings(rig_file: RigFile) -> TwinSettings:
    """The validated ``[twin]`` section of ``rig_file``.

    Raises InputError naming every wrong field with what is allowed there, and for a board that a twin does not print.
    """
    if rig_file.board.dark_spots:
        raise InputError(f"rig {rig_file.name}: a twin prints white spots on dark ink; leave board.dark_spots out")
    try:
        return TwinSettings.model_validate(rig_file.driver_section("twin"), strict=True)
    except ValidationError as error:
        where = f"section [twin] of rig {rig_file.name}"
        raise InputError(describe_validation_error(error, where, TwinSettings)) from None


def load_twin_file(name_or_path: str | Path, overrides: Sequence[str] = ()) -> tuple[RigFile, TwinSettings]:
    """A rig file, see ``instrument.rigfile.load_rig_file``, that must be a twin's, and its ``[twin]`` section.

    Raises InputError for one that is not read, for wrong fields, and for a rig whose driver is not the twin.
    """
    rig_file = load_rig_file(name_or_path, overrides)
    if rig_file.driver != "greenough.twin:open_rig":
        raise InputError(f"rig {name_or_path} is driven by {rig_file.driver}: only a twin has a bench with the truth")
    return rig_file, twin_settings(rig_file)
