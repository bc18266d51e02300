"""The rig of real devices: LightCrafter, a triggered camera, a Zaber stage and an operator, behind the contract.

Which address each has is up to the rig file; emulated devices are reached in the same way.
"""

import logging
import time
from contextlib import ExitStack
from functools import partial
from types import TracebackType
from typing import Self

import numpy as np

from .camera_process import CameraProcess
from .console_operator import ConsoleOperator
from .contract import (
    DeviceReport,
    Frames,
    KnownUncertainty,
    Operator,
    Procedure,
    RigIdentity,
    SpotBoard,
)
from .device_errors import DeviceError
from .errors import InputError
from .genicam_camera import GenicamCamera, GenicamSettings
from .hardware_settings import HardwareSettings, hardware_settings
from .lightcrafter import LightCrafter, in_batches
from .limits import check_patterns
from .remote_operator import RemoteOperator
from .rigfile import CameraSection, RigFile
from .triggered_camera import Shot, TriggeredCamera
from .uvc_camera import open_uvc_camera
from .zaber_stage import ZaberStage

STANDS_STILL_MM = 1e-3
"""How far the stage's reading may differ between the beginning and the end of a capture: an encoder's last counts."""

_log = logging.getLogger(__name__)


def open_rig(rig_file: RigFile, run: str = "default", exposures_done: int = 0) -> "HardwareRig":
    """The driver's entry. Nothing is connected before the rig's context is entered."""
    settings = hardware_settings(rig_file)
    shape = rig_file.projector.shape
    if shape != LightCrafter.shape:
        raise InputError(
            f"rig {rig_file.name}: projector.rows and cols are {shape[0]} and {shape[1]}, a LightCrafter has "
            f"{LightCrafter.shape[0]} and {LightCrafter.shape[1]}"
        )
    return HardwareRig(rig_file, settings, run, exposures_done)


class HardwareRig:
    """A profilometer of devices; see ``contract.Rig``. Its parts are there while its context lasts.

    Entering connects and reads; nothing moves and nothing is lit. Leaving makes the projector dark, stops the stage and
    lets go of all devices, and so does every error on the way in. What any device does wrong is a DeviceError.
    """

    def __init__(self, rig_file: RigFile, settings: HardwareSettings, run: str, exposures_done: int):
        self._rig_file, self._settings, self._run = rig_file, settings, run
        self._serial = exposures_done
        self._opened = ExitStack()
        self._projector = LightCrafter(settings.lightcrafter.settings)
        self.stage = ZaberStage(settings.zaber, rig_file.stage.limits_mm)
        self.operator: Operator = (
            ConsoleOperator(rig_file.procedure.postures, settings.operator.wait_s)
            if settings.operator.kind == "console"
            else RemoteOperator(settings.operator.host_and_port, settings.operator.wait_s)
        )
        self._camera: TriggeredCamera | None = None
        self._opened_s = 0.0

    @property
    def identity(self) -> RigIdentity:
        camera = self.camera.identity
        serial = camera.serial or f"{camera.vendor} {camera.model}".strip()
        # A LightCrafter has no serial number to ask for.
        return self._rig_file.identity(serial, f"LightCrafter with {self._projector.versions.dm365}")

    @property
    def devices(self) -> tuple[DeviceReport, ...]:
        """What answers, as it says itself."""
        projector, camera, stage = self._settings.lightcrafter, self.camera.identity, self.stage.identity
        versions = self._projector.versions
        reports = [
            DeviceReport(
                "projector",
                f"LightCrafter at {projector.host}:{projector.port}",
                "TI DLP LightCrafter",
                f"{versions.dm365}, {versions.fpga}, {versions.msp430}",
            ),
            DeviceReport(
                "camera",
                _camera_name(self._settings),
                " ".join(part for part in (camera.vendor, camera.model, camera.serial) if part),
                camera.firmware,
            ),
        ]
        if stage is not None:
            identity = f"device {stage.device_id}, serial number {stage.serial}"
            reports.append(DeviceReport("stage", f"stage on {self._settings.zaber.port}", identity, stage.firmware))
        return tuple(reports)

    @property
    def board(self) -> SpotBoard:
        return self._rig_file.board.nominal

    @property
    def procedure(self) -> Procedure:
        return self._rig_file.procedure.contract

    @property
    def uncertainty(self) -> KnownUncertainty:
        return self._rig_file.uncertainty.contract

    @property
    def camera(self) -> TriggeredCamera:
        if self._camera is None:
            raise RuntimeError("a rig of devices works inside its context only: with open_rig(...) as rig")
        return self._camera

    @property
    def projector(self) -> LightCrafter:
        return self._projector

    def capture(self, patterns: np.ndarray) -> Frames:
        """One exposure per pattern; more than the projector's memory holds are uploaded and shown in batches.

        Raises
        ------
        InputError
            When ``patterns`` are not (N, rows, cols) uint8 of the projector's shape, before anything is sent.
        DeviceError
            When a device fails, or the stage does not stand still meanwhile. It is dark then, and there are no frames.
        """
        check_patterns(patterns, self._projector.shape)
        camera, stage_mm = self.camera, self.stage.position_mm
        try:
            camera.arm()
            shots = [shot for batch in in_batches(patterns) for shot in self._expose(camera, batch)]
            camera.disarm()
        except BaseException:
            self._make_safe(camera)
            raise
        moved_mm = self.stage.position_mm - stage_mm
        if abs(moved_mm) > STANDS_STILL_MM:
            raise DeviceError(
                f"stage on {self._settings.zaber.port}",
                "stand still during a capture",
                f"it moved by {1e3 * moved_mm:.3g} um",
                "keep hands off its knob and run again",
            )
        return Frames(
            stack=np.stack([shot.image for shot in shots]),
            full_scale_dn=camera.full_scale_dn,
            black_level_dn=camera.black_level_dn,
            exposure_us=camera.exposure_us,
            gain_db=camera.gain_db,
            stage_position_mm=stage_mm,
            serials=self._serial - len(shots) + np.arange(len(shots), dtype=np.int64),
            times_s=np.array([shot.time_s for shot in shots]) - self._opened_s,
            run=self._run,
        )

    def _expose(self, camera: TriggeredCamera, batch: np.ndarray) -> list[Shot]:
        """One shot per pattern of what the projector's memory holds."""
        projector = self._projector
        projector.set_timing(camera.exposure_us)
        projector.upload(batch)
        shots = []
        for index in range(len(batch)):
            if index == 0:
                projector.start()
            else:
                projector.advance()
            time.sleep(self._settings.lightcrafter.settle_exposures * camera.exposure_us * 1e-6)
            self._serial += 1  # also of an exposure that fails: no two have one number
            shots.append(camera.trigger_and_grab())
        projector.stop()
        return shots

    def _make_safe(self, camera: TriggeredCamera) -> None:
        """Dark, and no frame under way. The error that led here is the one to report."""
        for action in (self._projector.darken, camera.disarm):
            try:
                action()
            except DeviceError as error:
                _log.warning("%s", error)

    def __enter__(self) -> Self:
        with ExitStack() as opened:
            opened.enter_context(self._projector)
            opened.enter_context(self.stage)
            section = _exposed_as_shown(self._rig_file.camera, self._projector.exposure_limits_us)
            self._camera = open_camera(section, self._settings)
            opened.callback(self._camera.close)
            self._opened_s = time.monotonic()
            self._opened = opened.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None, /
    ) -> None:
        self._camera = None
        self._opened.__exit__(kind, error, traceback)


def _exposed_as_shown(section: CameraSection, projector_us: tuple[float, float]) -> CameraSection:
    """The camera, exposed no shorter and no longer than the projector can show a pattern; InputError if it cannot."""
    low, high = max(section.exposure_min_us, projector_us[0]), min(section.exposure_max_us, projector_us[1])
    if low > high:
        raise InputError(
            f"the projector shows a pattern for {projector_us[0]:g} to {projector_us[1]:g} us, the rig file allows "
            f"exposures of {section.exposure_min_us:g} to {section.exposure_max_us:g} us: change "
            "camera.exposure_min_us and exposure_max_us."
        )
    return section.model_copy(update={"exposure_min_us": low, "exposure_max_us": high})


def open_camera(section: CameraSection, settings: HardwareSettings) -> TriggeredCamera:
    """The rig file's camera; a GenICam one in a process of its own, which its library may end.

    Raises InputError and DeviceError as the drivers do.
    """
    if isinstance(settings.camera, GenicamSettings):
        opener = partial(GenicamCamera, section, settings.camera)
        return CameraProcess(opener, _camera_name(settings), settings.camera.frame_timeout_s)
    return open_uvc_camera(section, settings.camera)


def _camera_name(settings: HardwareSettings) -> str:
    camera = settings.camera
    return f"camera at {camera.address if isinstance(camera, GenicamSettings) else camera.device}"
