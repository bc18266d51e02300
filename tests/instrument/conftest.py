"""A rig small enough to reason about, and the rigs that the conformance suite runs over."""

import hashlib
import itertools
from collections.abc import Callable, Iterator
from importlib import resources
from pathlib import Path
from typing import Self

import numpy as np
import pytest
from emulated_gige import free_address, need_aravis
from substituted_uvc import SubstitutedUvc

from greenough.instrument import hardware_rig, open_rig
from greenough.instrument.contract import (
    CameraNoise,
    DeviceReport,
    Frames,
    KnownUncertainty,
    Placement,
    Procedure,
    Rig,
    RigIdentity,
    SpotBoard,
)
from greenough.instrument.errors import InputError
from greenough.instrument.limits import check_patterns, check_within
from greenough.instrument.rigfile import CameraSection, load_rig_file
from greenough.instrument.uvc_camera import UvcCamera, UvcSettings
from greenough.twin.wire.emulated_rig import EmulatedRig
from greenough.twin.wire.twin_scene import TwinScene

FEW_PIXELS = ("camera.rows=48", "camera.cols=64")

PARTS = {"board": 0.9, "coin": 0.4}


class FakeCamera:
    shape = (12, 16)
    full_scale_dn = 255.0
    black_level_dn = 4.0
    noise = CameraNoise(full_well_e=6500.0, read_noise_e=10.0, electrons_per_dn=25.9)
    exposure_limits_us = (100.0, 1e6)

    def __init__(self) -> None:
        self._exposure_us = 8333.0

    @property
    def exposure_us(self) -> float:
        return self._exposure_us

    @exposure_us.setter
    def exposure_us(self, value: float) -> None:
        check_within(value, self.exposure_limits_us, "exposure time", "us")
        self._exposure_us = float(round(value))  # as a real camera, it takes whole microseconds


class FakeStage:
    limits_mm = (-1.6, 1.6)

    def __init__(self) -> None:
        self.position_mm = 0.0

    def move_to_mm(self, position: float) -> None:
        check_within(position, self.limits_mm, "stage position", "mm")
        self.position_mm = round(position / 47e-6) * 47e-6  # whole microsteps: the reading is not the target


class FakeOperator:
    def __init__(self) -> None:
        self.placement: Placement | None = None

    def place(self, placement: Placement) -> None:
        if placement.part not in PARTS:
            raise InputError(f"no sample {placement.part}; known: {', '.join(PARTS)}")
        self.placement = placement


class FakeProjector:
    shape = (6, 8)


class FakeRig:
    """Each camera pixel sees one mirror; the noise depends on (seed, serial) alone."""

    board = SpotBoard(3, 3, 0.65, 0.4, 0.175, 2.0, ((1, 1), (1, 2), (0, 1)))
    procedure = Procedure((8.0, 4.0), (4, 4), 6, 5, 0.1, 0.8, (4.0, 1.0))
    uncertainty = KnownUncertainty(3e-5, 5e-4, 5e-5)
    devices = (DeviceReport("camera", "fake camera", "camera-7", "1.0"),)

    def __init__(self, dtype: type = np.uint8, seed: int = 1) -> None:
        self.identity = RigIdentity("fake", "camera-7", "projector-3", hashlib.sha256(b"fake").hexdigest())
        self.camera = FakeCamera()
        self.stage = FakeStage()
        self.operator = FakeOperator()
        self.projector = FakeProjector()
        self.entered = False
        self._dtype = dtype
        self._seed = seed
        self._serial = 0

    def capture(self, patterns: np.ndarray) -> Frames:
        check_patterns(patterns, self.projector.shape)
        serials = np.arange(self._serial, self._serial + len(patterns))
        self._serial += len(patterns)
        placement = self.operator.placement
        albedo = PARTS[placement.part] if placement else 0.05
        light = albedo * patterns.repeat(2, axis=1).repeat(2, axis=2) * (self.camera.exposure_us / 20_000)
        noise = [np.random.default_rng([self._seed, n]).normal(0, 2, self.camera.shape) for n in serials.tolist()]
        stack = np.clip(light + self.camera.black_level_dn + np.array(noise), 0, self.camera.full_scale_dn)
        if np.issubdtype(self._dtype, np.integer):
            stack = np.rint(stack)
        return Frames(
            stack=stack.astype(self._dtype),
            full_scale_dn=self.camera.full_scale_dn,
            black_level_dn=self.camera.black_level_dn,
            exposure_us=self.camera.exposure_us,
            gain_db=0.0,
            stage_position_mm=self.stage.position_mm,
            serials=serials,
            times_s=serials / 30.0,
            run="default",
        )

    def __enter__(self) -> Self:
        self.entered = True
        return self

    def __exit__(self, *exc: object) -> None:
        self.entered = False


@pytest.fixture(scope="session")
def fake_rig() -> type[FakeRig]:
    return FakeRig


def small_twin() -> Rig:
    """The twin with few pixels; its optics stay, so it sees the middle of the field."""
    return open_rig("twin", FEW_PIXELS)


@pytest.fixture(scope="session")
def small_bench() -> Iterator[tuple[EmulatedRig, list[str]]]:
    """The same twin behind emulated devices, which stay switched on, and the settings by which drivers find them."""
    overrides = [*FEW_PIXELS, f'genicam.address="{free_address()}"']
    rig_file = load_rig_file("wire", overrides)
    with EmulatedRig(rig_file, TwinScene(rig_file), free_ports=True, homed=True) as emulated:
        yield emulated, [*overrides, *emulated.overrides]


@pytest.fixture(scope="session")
def small_wire(small_bench: tuple[EmulatedRig, list[str]]) -> Callable[[], Rig]:
    """Through the drivers, with a GenICam camera."""
    need_aravis()
    return lambda: open_rig("wire", small_bench[1])


@pytest.fixture(scope="session")
def small_uvc(
    small_bench: tuple[EmulatedRig, list[str]], tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Callable[[], Rig]]:
    """Through the drivers, with a UVC camera whose capture and controls are substituted."""
    emulated, overrides = small_bench
    path = tmp_path_factory.mktemp("rigs") / "uvc.toml"
    text = (resources.files("greenough.instrument") / "rigs/wire.toml").read_text()
    camera = "[uvc]\ndevice = '/dev/video9'\nframe_timeout_s = 300.0\nreadout_s = 0.0\n"
    path.write_text(text.partition("[genicam]")[0] + camera + "[operator]" + text.partition("[operator]")[2])
    numbers = itertools.count(10**6, 10**4)  # of exposures that no other camera takes

    def open_substituted(section: CameraSection, settings: UvcSettings) -> UvcCamera:
        layers = SubstitutedUvc(emulated.picture, next(numbers))
        return UvcCamera(section, settings, layers, layers)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(hardware_rig, "open_uvc_camera", open_substituted)
        yield lambda: open_rig(path, [setting for setting in overrides if "genicam" not in setting])


IMAGES = """
name = "few"
driver = "images"
camera = { rows = 12, cols = 16, bits = 8, black_level_dn = 4.0 }
projector = { rows = 6, cols = 8 }
board = { rows = 3, cols = 3, pitch_mm = 0.65, small_diameter_mm = 0.3, size_mm = 2.0 }
procedure = { periods_px = [8.0], steps = [4] }
uncertainty = { board_scale_ppm = 30.0, table_drift_um = 0.5, path_drift_um = 0.05 }
[images]
postures = "board{}.npy"
planes = "z{}.npy"
plane_step_mm = 0.5
"""


@pytest.fixture
def image_folder(tmp_path: Path) -> Path:
    """Two postures, planes at -0.5, 0 and 0.5 mm and a part, four frames each of its own grey value; a rig file."""
    for k, name in enumerate(("board1", "board2", "z-1", "z0", "z1", "part")):
        np.save(tmp_path / f"{name}.npy", np.full((4, 12, 16), 10 * (k + 1), np.uint8))
    (tmp_path / "rig.toml").write_text(IMAGES)
    return tmp_path


@pytest.fixture(params=[FakeRig, small_twin, "small_wire", "small_uvc"], ids=["fake", "twin", "wire", "uvc"])
def open_some_rig(request: pytest.FixtureRequest) -> Callable[[], Rig]:
    """Every rig that must keep the contract; each call opens it afresh."""
    return request.getfixturevalue(request.param) if isinstance(request.param, str) else request.param


@pytest.fixture
def patterns() -> np.ndarray:
    """Four uneven patterns for the fake rig's projector."""
    return np.random.default_rng(5).integers(0, 256, (4, *FakeProjector.shape), dtype=np.uint8)
