"""The twin as a rig: the contract of ``greenough.instrument`` in front of a renderer."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self, cast

import numpy as np

from greenough.instrument.contract import (
    CameraNoise,
    DeviceReport,
    Frames,
    KnownUncertainty,
    Placement,
    Procedure,
    RigIdentity,
    SpotBoard,
)
from greenough.instrument.errors import InputError
from greenough.instrument.limits import check_patterns, check_within
from greenough.instrument.rigfile import RigFile

from .bench import Bench
from .camera import build_sensor, displaced, expose
from .dmd import MARGIN, band_limited
from .instability import Instability
from .light_sums import LARGEST_REST, RIM, as_sums
from .plugins import FringeIntegrator
from .plugins.lens_projector import LensProjector
from .renderer import dr, mi
from .scene import camera_dict, integrator_dict, mirrors_passed, pixels_passed, projector_dict, specimen_dict
from .settings import TwinSettings, load_twin_file, twin_settings
from .workbench import Workbench

BLANKING_US = 250.0  # between two patterns, while the projector loads the next


class TwinCamera:
    """The camera's side of the contract."""

    def __init__(self, rig_file: RigFile) -> None:
        self._section = rig_file.camera
        self._exposure_us = self._section.exposure_min_us

    @property
    def shape(self) -> tuple[int, int]:
        return self._section.shape

    @property
    def full_scale_dn(self) -> float:
        return self._section.full_scale_dn

    @property
    def black_level_dn(self) -> float:
        return self._section.black_level_dn

    @property
    def noise(self) -> CameraNoise:
        return self._section.noise

    @property
    def exposure_limits_us(self) -> tuple[float, float]:
        return self._section.exposure_min_us, self._section.exposure_max_us

    @property
    def exposure_us(self) -> float:
        return self._exposure_us

    @exposure_us.setter
    def exposure_us(self, value: float) -> None:
        check_within(value, self.exposure_limits_us, "exposure time", "us")
        self._exposure_us = float(value)


class TwinProjector:
    """The projector's side of the contract."""

    def __init__(self, rig_file: RigFile) -> None:
        self.shape = rig_file.projector.shape


class TwinStage:
    """The stage's side of the contract: what it reads, not where it is."""

    def __init__(self, rig_file: RigFile, workbench: Workbench) -> None:
        self.limits_mm = rig_file.stage.limits_mm
        self._workbench = workbench

    @property
    def position_mm(self) -> float:
        return self._workbench.position

    def move_to_mm(self, position: float) -> None:
        check_within(position, self.limits_mm, "stage position", "mm")
        self._workbench.position = float(position)


class TwinOperator:
    """The hands that move the part in the twin."""

    def __init__(self, workbench: Workbench) -> None:
        self._workbench = workbench

    def place(self, placement: Placement) -> None:
        self._workbench.place(placement)


class TwinRig:
    """A profilometer, rendered; see ``greenough.instrument.contract.Rig``."""

    def __init__(self, rig_file: RigFile, workbench: Workbench, run: str, exposures_done: int) -> None:
        self._rig_file = rig_file
        self._settings: TwinSettings = twin_settings(rig_file)
        self._renderer = Renderer(rig_file, self._settings, workbench)
        self._workbench = workbench
        self._sensor = build_sensor(rig_file.camera, self._settings.camera, self._settings.seed)
        exposures = rig_file.procedure.contract.exposures
        self._instability = Instability(self._settings.stability, self._settings.seed, run, exposures)
        self._run = run
        self._serial = exposures_done
        self._clock_s = 0.0
        self.camera = TwinCamera(rig_file)
        self.projector = TwinProjector(rig_file)
        self.stage = TwinStage(rig_file, workbench)
        self.operator = TwinOperator(workbench)

    @property
    def identity(self) -> RigIdentity:
        seed = self._settings.seed
        return self._rig_file.identity(f"TWIN-CAMERA-{seed}", f"TWIN-PROJECTOR-{seed}")

    @property
    def devices(self) -> tuple[DeviceReport, ...]:
        identity = self.identity
        return (
            DeviceReport("projector", "projector of the twin", identity.projector_serial, ""),
            DeviceReport("camera", "camera of the twin", identity.camera_serial, ""),
            DeviceReport("stage", "stage of the twin", f"TWIN-STAGE-{self._settings.seed}", ""),
        )

    @property
    def board(self) -> SpotBoard:
        return self._rig_file.board.nominal

    @property
    def procedure(self) -> Procedure:
        return self._rig_file.procedure.contract

    @property
    def uncertainty(self) -> KnownUncertainty:
        return self._rig_file.uncertainty.contract

    def capture(self, patterns: np.ndarray) -> Frames:
        """One exposure per pattern; all patterns are rendered in one pass.

        Raises InputError when ``patterns`` are not (N, rows, cols) uint8 of the projector's shape, or when nothing is
        mounted.
        """
        check_patterns(patterns, self.projector.shape)
        exposure_us = self.camera.exposure_us
        stack = self.expose(patterns, exposure_us, self._serial, began=self._serial)
        n = len(patterns)
        period_s = (exposure_us + BLANKING_US) * 1e-6
        frames = Frames(
            stack=stack,
            full_scale_dn=self._sensor.full_scale_dn,
            black_level_dn=self.camera.black_level_dn,
            exposure_us=exposure_us,
            gain_db=0.0,
            stage_position_mm=self.stage.position_mm,
            serials=self._serial + np.arange(n, dtype=np.int64),
            times_s=self._clock_s + np.arange(n) * period_s,
            run=self._run,
        )
        self._serial += n
        self._clock_s += n * period_s
        return frames

    def expose(
        self, patterns: np.ndarray, exposure_us: float, serial: int, began: int, lamp: float = 1.0
    ) -> np.ndarray:
        """Grey values (N, rows, cols) of one exposure per pattern, and nothing else: neither counter nor clock go on.

        A frame is the same whether it is exposed alone or together with others of its capture.

        Parameters
        ----------
        patterns : (N, rows, cols) uint8
            Of the projector's shape.
        exposure_us : float
        serial : int
            Of the first of these exposures in the run.
        began : int
            Of the first exposure of the capture that they belong to: in one capture nothing drifts.
        lamp : float
            Light of the projector, relative to what the rig file states. Without any nothing need be mounted.

        Raises
        ------
        InputError
            When nothing is mounted.
        """
        photons = self._settings.light.white_photons_per_ms * exposure_us * 1e-3
        white = self._settings.camera.quantum_efficiency * photons  # in electrons
        serials = serial + np.arange(len(patterns), dtype=np.int64)
        optics, changes = self._settings.optics, self._instability
        self._workbench.drift = changes.table_drift(began)
        motion = changes.vibration(serials) + self._workbench.drift
        sideways = [[changes.path_drift(began) / (optics.column_pitch_um * 1e-3), 0.0]]
        drifted = mirrors_passed(optics, self._workbench.drift[None]) + sideways
        if lamp > 0:
            images = self._renderer.radiance(patterns, mirrors_passed(optics, motion) + sideways, drifted[0])
        else:
            images = [dr.zeros(mi.Float, self.camera.shape[0] * self.camera.shape[1])] * len(patterns)
        moved = pixels_passed(optics, motion)
        ambient = dr.opaque(mi.Float, self._settings.light.ambient * white)  # one kernel for all exposure times
        brightness = np.pi * white * lamp * changes.flicker(serials)
        electrons = [
            displaced(image, self.camera.shape, shift) * dr.opaque(mi.Float, float(factor)) + ambient
            for image, shift, factor in zip(images, moved, brightness, strict=True)
        ]
        return expose(electrons, self._sensor, self._settings.seed, self._run, serial)

    def irradiance(self, patterns: np.ndarray) -> np.ndarray:
        """What the camera is exposed to: radiance of all patterns before any noise, (N, rows, cols) float32.

        A white Lambertian surface under a white pattern gives 1/pi. Raises InputError as ``capture`` does.
        """
        channels = self._renderer.radiance(patterns)
        return np.stack([np.array(channel).reshape(self.camera.shape) for channel in channels])

    def scene_dict(self, patterns: np.ndarray) -> dict[str, Any]:
        """The scene of what is mounted, see ``greenough.twin.scene_dict``."""
        return self._renderer.scene_dict(patterns)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        pass


@dataclass(frozen=True, eq=False)
class Together:
    """Pictures of white and of the procedure's fringes that were rendered in one pass.

    Parameters
    ----------
    place : object
        What was mounted, and where.
    light : (1 + N, cells)
        The patterns along the columns.
    images : list of 1 + N arrays (rows * cols,)
    """

    place: object
    light: np.ndarray
    images: list[mi.Float]


class Renderer:
    """Renders what the workbench holds, and keeps what exposures of one scene share.

    That is the scene; the interreflections of the last patterns, which do not change with the shifts of a micrometre
    that the patterns may have; and the last result. Tracing light takes far longer than adding up patterns: together
    with white, which sets the exposure, the fringes that are captured next are rendered and kept.
    """

    def __init__(self, rig_file: RigFile, settings: TwinSettings, workbench: Workbench) -> None:
        self._shape = rig_file.camera.shape
        self._projector_shape = rig_file.projector.shape
        self._settings = settings
        self._workbench = workbench
        self._sensor = mi.load_dict(camera_dict(settings, self._shape))
        nothing = np.zeros((1, *self._projector_shape), np.uint8)
        self._projector = cast(LensProjector, mi.load_dict(projector_dict(settings, nothing)))
        self._loaded: tuple[object, mi.Scene] | None = None
        self._interreflections: tuple[object, list[mi.Float]] | None = None
        self._kept: tuple[object, list[mi.Float]] | None = None
        fringes = _fringe_lines(rig_file.procedure.contract, self._projector_shape[1])
        self._lines = np.concatenate([np.full_like(fringes[:1], 255), fringes])
        self._together: Together | None = None

    def radiance(
        self, patterns: np.ndarray, shift: np.ndarray | None = None, drifted: np.ndarray | None = None
    ) -> list[mi.Float]:
        """Radiance of each pattern, N arrays of (rows * cols,), the patterns moved by ``shift`` (N, 2).

        Patterns of one grey value are not moved: only the rim of the light would. Where ``drifted`` (2,) says how far
        all patterns have moved, white ones are rendered together with the fringes of the rig's procedure, moved so; as
        long as nothing else is mounted, and nothing moved in between, fringes are then sums of these, see `light_sums`.
        """
        check_patterns(patterns, self._projector_shape)
        shift = np.zeros((len(patterns), 2)) if shift is None else shift
        # Images that set the exposure need not be rendered again and again.
        uniform = patterns.min(axis=(1, 2)) == patterns.max(axis=(1, 2))
        shift = np.where(uniform[:, None], 0.0, shift)
        place = (self._workbench.mounted, self._workbench.position)
        shown = (*place, hashlib.sha256(patterns.tobytes()).digest())
        state = (*shown, shift.tobytes())
        if self._kept is None or self._kept[0] != state:
            self._kept = None  # the old stack is freed before the new one is made
            if self._loaded is None or self._loaded[0] != place:
                self._loaded = (place, mi.load_dict(self._scene(self._projector)))
            scene = self._loaded[1]
            if drifted is not None and (images := self._sums(scene, place, patterns, shift, drifted)):
                self._kept = (state, images)
                return images
            self._projector.set_patterns(patterns, shift)
            integrator, sensor = cast(FringeIntegrator, scene.integrator()), scene.sensors()[0]
            if self._interreflections is None or self._interreflections[0] != shown:
                self._interreflections = None
                if integrator.bounces > 1:
                    self._interreflections = (shown, integrator.render_interreflections(scene, sensor))
            more = self._interreflections[1] if self._interreflections else None
            self._kept = (state, integrator.render_channels(scene, sensor, interreflections=more))
            dr.sync_thread()
        return self._kept[1]

    def _sums(
        self, scene: mi.Scene, place: object, patterns: np.ndarray, shift: np.ndarray, drifted: np.ndarray
    ) -> list[mi.Float] | None:
        """What `radiance` returns, from pictures that were rendered together; None where they do not make it up."""
        known = {line.tobytes(): k for k, line in enumerate(self._lines)}
        own = np.array([known.get(line.tobytes(), -1) for line in patterns[:, 0]])
        if (own < 0).any() or (patterns != patterns[:, :1]).any():
            return None
        if self._together is None or self._together.place != place:
            if own.any():
                return None  # nobody has set an exposure here
            self._together = self._interreflections = None  # freed before the next are made
            every = np.broadcast_to(self._lines[:, None], (len(self._lines), *self._projector_shape))
            moved = np.where(np.arange(len(every))[:, None] > 0, drifted, 0.0)
            self._projector.set_patterns(every, moved)
            images = cast(FringeIntegrator, scene.integrator()).render_channels(scene, scene.sensors()[0])
            self._together = Together(place, self._along_columns(every, moved), images)
            dr.sync_thread()
        sums = as_sums(self._along_columns(patterns, shift), own, self._together.light)
        if sums.rest > LARGEST_REST:
            return None
        images = []
        for terms, weights in zip(sums.terms, sums.weights, strict=True):
            # One by one, so that one kernel serves whatever the terms are.
            of = [dr.opaque(mi.Float, float(w)) * self._together.images[k] for k, w in zip(terms, weights, strict=True)]
            images.append(of[0] + of[1] + of[2])
            dr.eval(images[-1])
        return images

    def _along_columns(self, patterns: np.ndarray, shift: np.ndarray) -> np.ndarray:
        """Light of patterns that do not vary along the rows, (N, cells), without the rims at either end."""
        projector = self._projector
        table = band_limited(patterns, projector.mirrors, projector.na, projector.wavelength, shift)
        rim = (MARGIN + RIM) * table.cells[0]
        return table.values[0, rim:-rim].T.astype(np.float64)

    def scene_dict(self, patterns: np.ndarray) -> dict[str, Any]:
        """The scene with its own sensor and projector as dictionaries."""
        check_patterns(patterns, self._projector_shape)
        projector = projector_dict(self._settings, patterns)
        return self._scene(projector) | {"sensor": camera_dict(self._settings, self._shape)}

    def _scene(self, projector: object) -> dict[str, Any]:
        mounted = self._workbench.mounted
        if mounted is None:
            raise InputError("nothing is mounted: let the operator place a part before frames are captured")
        return {
            "type": "scene",
            "embree_use_robust_intersections": True,
            "integrator": integrator_dict(self._settings.render, mounted.flat),
            "sensor": self._sensor,
            "projector": projector,
        } | specimen_dict(self._workbench.parts_in_twin(), self._settings.render)


def open_rig(rig_file: RigFile, run: str = "default", exposures_done: int = 0) -> TwinRig:
    """The driver's entry: the rig alone, without its bench."""
    settings = twin_settings(rig_file)
    return TwinRig(rig_file, Workbench(rig_file, settings), run, exposures_done)


def open(
    name_or_path: str | Path = "twin", overrides: Sequence[str] = (), run: str = "default", exposures_done: int = 0
) -> tuple[TwinRig, Bench]:
    """Open a twin together with the bench that knows its truth.

    Parameters are those of ``greenough.instrument.open_rig``. Raises InputError for a rig whose driver is not the twin.
    """
    rig_file, settings = load_twin_file(name_or_path, overrides)
    workbench = Workbench(rig_file, settings)
    return TwinRig(rig_file, workbench, run, exposures_done), Bench(rig_file, settings, workbench)


def scene_dict(rig: TwinRig, sample: str | Placement, patterns: np.ndarray | None = None) -> dict[str, Any]:
    """The whole Mitsuba scene as one dictionary for ``mi.load_dict``: both paths, projector, sensor, meshes, materials.

    ``mi.render`` of the loaded scene is the rig's irradiance stack, (rows, cols, N).

    Parameters
    ----------
    rig : TwinRig
        The instrument; ``sample`` is placed on it.
    sample : str or Placement
        What lies under the lenses.
    patterns : (N, rows, cols) uint8, optional
        What is projected; default is the fringe set of the rig's procedure.
    """
    rig.operator.place(Placement(sample) if isinstance(sample, str) else sample)
    return rig.scene_dict(fringe_patterns(rig) if patterns is None else patterns)


def fringe_patterns(rig: TwinRig) -> np.ndarray:
    """The fringe set of the rig's procedure by eq. 1, (N, rows, cols) uint8."""
    rows, cols = rig.projector.shape
    return np.repeat(_fringe_lines(rig.procedure, cols)[:, None], rows, axis=1)


def _fringe_lines(procedure: Procedure, cols: int) -> np.ndarray:
    """One row of each of the patterns, (N, cols) uint8."""
    column = np.arange(cols)
    sets = zip(procedure.periods_px, procedure.steps, strict=True)
    lines = [127.5 * (1 + np.cos(2 * np.pi * (column / p + n / steps))) for p, steps in sets for n in range(steps)]
    # Exact halves must round alike in every period, whatever the cosine's last digit says.
    return np.rint(np.round(lines, 9)).astype(np.uint8)
