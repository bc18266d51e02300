"""The sections of a rig file that say how its devices are reached: projector, camera, stage and operator."""

from dataclasses import dataclass
from typing import Annotated, Any, Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from .errors import InputError
from .genicam_camera import GenicamSettings
from .lightcrafter import LightCrafterSettings
from .lightcrafter_commands import PORT, Led
from .rigfile import RigFile, describe_validation_error
from .uvc_camera import UvcSettings
from .zaber_stage import ZaberSettings

EMULATION = "twin"
"""The section of the emulated devices' physics, which `greenough serve` reads and no driver does."""

_SECTION = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)
_Steps = Annotated[int, Field(ge=0, le=65_535)]
_Section = TypeVar("_Section", bound=BaseModel)


class LightCrafterSection(BaseModel):
    """``[lightcrafter]``: how the projector is reached and used.

    Parameters
    ----------
    host, port : str, int
        The defaults are those it leaves the factory with.
    led : "red", "green" or "blue"
        What lights the patterns.
    led_current : int
        Of that LED, in the device's own steps; the others are off.
    led_current_max : int
        The largest that is allowed; 255 is the largest that public software sends.
    long_axis_flip, short_axis_flip : bool
        How the picture is turned on the mirrors.
    exposure_max_us : int
        The longest exposure of a pattern; older firmware ends at 20 000.
    settle_exposures : float
        Pause after a pattern is called up, before the camera is triggered, in exposures: a pattern may begin only when
        the one before has ended.
    timeout_s, busy_s : float
        How long a connection or a reply may take, and how long a device that says it is busy is asked again.
    """

    model_config = _SECTION
    host: Annotated[str, Field(min_length=1, max_length=200, examples=["192.168.1.100"])] = "192.168.1.100"
    port: Annotated[int, Field(ge=1, le=65_535)] = PORT
    led: Literal["red", "green", "blue"] = "green"
    led_current: _Steps = 255
    led_current_max: _Steps = 255
    long_axis_flip: bool = False
    short_axis_flip: bool = False
    exposure_max_us: Annotated[int, Field(ge=8333, le=5_000_000)] = 5_000_000
    settle_exposures: Annotated[float, Field(ge=0, le=10)] = 1.0
    timeout_s: Annotated[float, Field(ge=0.05, le=600)] = 5.0
    busy_s: Annotated[float, Field(ge=0, le=600)] = 5.0

    @property
    def settings(self) -> LightCrafterSettings:
        """What the driver takes."""
        leds = ("red", "green", "blue")
        red, green, blue = (self.led_current if led == self.led else 0 for led in leds)
        return LightCrafterSettings(
            host=self.host,
            port=self.port,
            led=Led[self.led.upper()],
            led_current=(red, green, blue),
            led_current_max=self.led_current_max,
            long_axis_flip=self.long_axis_flip,
            short_axis_flip=self.short_axis_flip,
            exposure_max_us=self.exposure_max_us,
            timeout_s=self.timeout_s,
            busy_s=self.busy_s,
        )


class OperatorSection(BaseModel):
    """``[operator]``: whose hands lay the parts down.

    Parameters
    ----------
    kind : "console" or "remote"
        A person at this terminal, or a bench that takes placements at ``address``.
    address : str
        ``host:port``, of a remote one.
    wait_s : float
        How long a placement may take.
    """

    model_config = _SECTION
    kind: Literal["console", "remote"] = "console"
    address: Annotated[str, Field(pattern=r"^(\S+:\d{1,5})?$", examples=["127.0.0.1:21846"])] = ""
    wait_s: Annotated[float, Field(gt=0, le=86_400)] = 3600.0

    @property
    def host_and_port(self) -> tuple[str, int]:
        host, _, port = self.address.rpartition(":")
        return host, int(port)


@dataclass(frozen=True)
class HardwareSettings:
    """All of them; ``camera`` says by its type which driver the camera has."""

    lightcrafter: LightCrafterSection
    zaber: ZaberSettings
    camera: GenicamSettings | UvcSettings
    operator: OperatorSection


def hardware_settings(rig_file: RigFile) -> HardwareSettings:
    """The validated sections of ``rig_file``.

    Raises
    ------
    InputError
        For a section that is missing, unknown or wrong, and where there is not exactly one camera.
    """
    known = ("lightcrafter", "zaber", "genicam", "uvc", "operator", EMULATION)
    unknown = [name for name in rig_file.driver_sections if name not in known]
    if unknown:
        raise InputError(
            f"rig {rig_file.name}: there is no section [{unknown[0]}] of its driver; it has {', '.join(known)}"
        )
    cameras = [name for name in ("genicam", "uvc") if name in rig_file.driver_sections]
    if len(cameras) != 1:
        raise InputError(
            f"rig {rig_file.name} has {len(cameras)} cameras: give one of the sections [genicam] and [uvc]"
        )
    operator = _section(rig_file, "operator", OperatorSection)
    if operator.kind == "remote" and not operator.address:
        raise InputError(f"rig {rig_file.name}: operator.address is missing and must be host:port of the remote bench")
    return HardwareSettings(
        lightcrafter=_section(rig_file, "lightcrafter", LightCrafterSection),
        zaber=_section(rig_file, "zaber", ZaberSettings),
        camera=_section(rig_file, cameras[0], GenicamSettings if cameras[0] == "genicam" else UvcSettings),
        operator=operator,
    )


def _section(rig_file: RigFile, name: str, model: type[_Section]) -> _Section:
    values: dict[str, Any] = rig_file.driver_section(name)
    try:
        return model.model_validate(values, strict=True)
    except ValidationError as error:
        where = f"section [{name}] of rig {rig_file.name}"
        raise InputError(describe_validation_error(error, where, model)) from None
