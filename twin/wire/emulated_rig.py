"""All devices of a rig, emulated around one scene: what the wires carry is all that is known of it outside.

What was uploaded is what is projected, the exposure that was set is the one that is rendered, and the stage is where it
went. A sequence is exposed in one pass when its first pattern is asked for; frames still leave one per trigger.
"""

import threading
from contextlib import ExitStack
from dataclasses import dataclass
from types import TracebackType
from typing import Protocol, Self
from urllib.parse import urlsplit

import numpy as np

from greenough.instrument.contract import Placement
from greenough.instrument.errors import InputError
from greenough.instrument.genicam_camera import GenicamSettings
from greenough.instrument.hardware_settings import HardwareSettings, hardware_settings
from greenough.instrument.lightcrafter_commands import SHAPE
from greenough.instrument.rigfile import RigFile
from greenough.instrument.zaber_stage import ZaberSettings

from .gige_camera import GigeCamera, Trigger
from .gige_registers import CameraModel
from .lightcrafter import LightCrafterServer
from .lightcrafter_device import LightCrafterDevice, Shown
from .line_server import LineServer
from .placements import PlacementServer
from .zaber import StageModel, ZaberDevice

FULL_CURRENT = 255
"""Steps of the LED's current at which it shines as the rig file says; at fewer, in proportion."""

_PIXEL_FORMATS = {8: "Mono8", 16: "Mono16"}
_DARK = np.zeros((1, *SHAPE), np.uint8)


class Scene(Protocol):
    """What lies before the lenses. Several threads ask it, but one at a time."""

    def place(self, placement: Placement) -> None:
        """Lay a part down. Raises InputError for one that is not known."""
        ...

    def move_to_mm(self, position: float) -> None:
        """The stage stands at ``position`` by its own count."""
        ...

    def expose(self, patterns: np.ndarray, exposure_us: float, serial: int, began: int, lamp: float) -> np.ndarray:
        """Frames (N, rows, cols), one per pattern; see ``greenough.twin.rig.TwinRig.expose``."""
        ...


@dataclass(frozen=True, eq=False)
class _Ahead:
    """Frames that were exposed together with the one that was asked for, in case the others are asked for in turn."""

    of: tuple[object, ...]  # everything that they depend on
    first: int  # pattern of the first frame
    frames: np.ndarray


class EmulatedRig:
    """Emulated LightCrafter, GigE Vision camera, Zaber stage and bench, reachable from ``with`` to its end.

    Parameters
    ----------
    rig_file : RigFile
        Of the driver ``greenough.instrument.hardware_rig``. The devices listen at its addresses, and the stage counts
        its microsteps.
    scene : Scene
    serial : str
        The camera's serial number.
    free_ports : bool
        Listen at its addresses, but on any ports that are free; see ``overrides``.
    instant_stage : bool
        Whether the stage arrives as soon as it is sent.
    homed : bool
        Whether the stage has been homed, and then sent to 0 mm.
    exposures_done : int
        Exposures of the scene's run that were taken before.
    allow_remote : bool
        Take other addresses than loopback.

    Attributes
    ----------
    projector, projector_server : LightCrafterDevice, LightCrafterServer
    camera : GigeCamera
    stage, stage_server : ZaberDevice, LineServer
        The server exists inside the context.

    Raises
    ------
    InputError
        For a rig file with a camera or operator that is not emulated, for addresses that are not loopback, and on
        entering for ports that are taken.
    """

    def __init__(
        self,
        rig_file: RigFile,
        scene: Scene,
        serial: str = "1",
        free_ports: bool = False,
        instant_stage: bool = True,
        homed: bool = False,
        exposures_done: int = 0,
        allow_remote: bool = False,
    ):
        self._settings = hardware_settings(rig_file)
        projector, zaber = self._settings.lightcrafter, self._settings.zaber
        camera = _emulated(rig_file, self._settings)
        self._scene, self._exposures_done = scene, exposures_done
        self._free_ports, self._allow_remote = free_ports, allow_remote
        self._asking = threading.Lock()
        self._position_mm, self._placements = 0.0, 0
        self._ahead: _Ahead | None = None
        self.projector = LightCrafterDevice()
        self.projector_server = LightCrafterServer(
            self.projector, projector.host, self._port(projector.port), allow_remote=allow_remote
        )
        self._microstep_um, self._zero, self._direction = zaber.microstep_um, zaber.zero_microsteps, zaber.direction
        self.stage = ZaberDevice(_stage_model(rig_file, zaber, instant_stage, homed), self._stage_moved)
        if homed:
            self.stage.reference()
        self._stage_moved(self.stage.position)
        model = CameraModel(
            vendor="Greenough",
            model="Emulated camera",
            serial=serial,
            firmware="1.0",
            shape=rig_file.camera.shape,
            exposure_limits_us=(rig_file.camera.exposure_min_us, rig_file.camera.exposure_max_us),
            pixel_format=_PIXEL_FORMATS[rig_file.camera.bits],
        )
        self.camera = GigeCamera(model, self.picture, camera.address, allow_remote)
        self._opened = ExitStack()

    @property
    def addresses(self) -> dict[str, str]:
        """Where each device listens."""
        return {
            "projector": f"{self._settings.lightcrafter.host}:{self.projector_server.port}",
            "camera": self.camera.host,
            "stage": f"{self.stage_server.url} and {self.stage_server.terminal}",
            "placements": f"{self._settings.operator.host_and_port[0]}:{self._placement_server.port}",
        }

    @property
    def overrides(self) -> list[str]:
        """Settings by which ``open_rig`` finds the devices on the ports that were free."""
        host = self._settings.operator.host_and_port[0]
        return [
            f"lightcrafter.port={self.projector_server.port}",
            f'zaber.port="{self.stage_server.url}"',
            f'operator.address="{host}:{self._placement_server.port}"',
        ]

    def __enter__(self) -> Self:
        with ExitStack() as opened:
            opened.enter_context(self.projector_server)
            stage = urlsplit(self._settings.zaber.port)
            self.stage_server = opened.enter_context(
                LineServer(self.stage, stage.hostname or "", self._port(stage.port or 0), self._allow_remote)
            )
            host, port = self._settings.operator.host_and_port
            self._placement_server = opened.enter_context(
                PlacementServer(self._place, host, self._port(port), self._allow_remote)
            )
            opened.enter_context(self.camera)
            self._opened = opened.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None, /
    ) -> None:
        self._opened.__exit__(kind, error, traceback)

    def _port(self, port: int) -> int:
        return 0 if self._free_ports else port

    def _place(self, placement: Placement) -> None:
        with self._asking:
            self._scene.place(placement)
            self._placements += 1

    def _stage_moved(self, microsteps: float) -> None:
        # The same arithmetic as the driver's, so that the scene and the host mean the same place to the last bit.
        self._position_mm = self._direction * (microsteps - self._zero) * self._microstep_um * 1e-3

    def picture(self, trigger: Trigger) -> np.ndarray:
        """The frame of one trigger, (rows, cols)."""
        with self._asking:
            shown = self.projector.shown
            serial, began = (self._exposures_done + number for number in (trigger.number, trigger.first))
            self._scene.move_to_mm(self._position_mm)
            if shown is None:
                return self._scene.expose(_DARK, trigger.exposure_us, serial, began, lamp=0.0)[0]
            lamp = _lamp(shown)
            # Exposure and pattern count on together: a sequence is told by the number that its first exposure has.
            of = (
                shown.upload,
                lamp,
                trigger.exposure_us,
                began,
                self._position_mm,
                self._placements,
                serial - shown.index,
            )
            ahead = self._ahead
            if ahead is None or ahead.of != of or shown.index < ahead.first:
                patterns = shown.patterns[shown.index :]
                frames = self._scene.expose(patterns, trigger.exposure_us, serial, began, lamp)
                ahead = self._ahead = _Ahead(of, shown.index, frames)
            return ahead.frames[shown.index - ahead.first]


def _emulated(rig_file: RigFile, settings: HardwareSettings) -> GenicamSettings:
    """The camera's settings, if everything that the rig file names can be emulated; InputError if not."""
    if not isinstance(settings.camera, GenicamSettings):
        raise InputError(f"rig {rig_file.name} has a UVC camera, which is not emulated: give it a section [genicam]")
    if rig_file.camera.bits not in _PIXEL_FORMATS:
        raise InputError(f"rig {rig_file.name}: camera.bits = {rig_file.camera.bits} must be 8 or 16 on a wire")
    if not settings.zaber.port.startswith("socket://"):
        raise InputError(
            f"rig {rig_file.name}: zaber.port = {settings.zaber.port} cannot be emulated; give socket://127.0.0.1:PORT"
        )
    if settings.operator.kind != "remote":
        raise InputError(f'rig {rig_file.name}: operator.kind must be "remote", for no person reaches the bench')
    return settings.camera


def _stage_model(rig_file: RigFile, settings: ZaberSettings, instant: bool, homed: bool) -> StageModel:
    """A stage that reaches beyond the rig file's limits by their distance; switched on below them, or homed at 0 mm."""
    low, high = rig_file.stage.limits_mm
    step_mm = settings.direction * settings.microstep_um * 1e-3
    steps = [settings.zero_microsteps + round(z / step_mm) for z in (low, high)]
    margin = abs(steps[1] - steps[0])
    if min(steps) < margin:
        raise InputError(
            f"rig {rig_file.name}: zaber.zero_microsteps = {settings.zero_microsteps} leaves too little room below the "
            f"limits of [stage]; make it {settings.zero_microsteps + margin - min(steps)} or more"
        )
    start = settings.zero_microsteps if homed else min(steps) - margin // 2
    return StageModel(travel=max(steps) + margin, start=start, instant=instant)


def _lamp(shown: Shown) -> float:
    """Light of the LED that the sequence is shown with, relative to its full current."""
    return shown.led_current[min(shown.sequence.led, len(shown.led_current) - 1)] / FULL_CURRENT
