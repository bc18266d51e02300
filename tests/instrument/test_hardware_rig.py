"""A rig of devices: what each does wrong is an error of the whole, in the dark and at rest, and numbers go on."""

from collections.abc import Callable, Iterator

import numpy as np
import pytest
from emulated_gige import free_address, need_aravis

from greenough.instrument import open_rig
from greenough.instrument.contract import Placement
from greenough.instrument.device_errors import DeviceError, Fault, TimedOut
from greenough.instrument.errors import InputError
from greenough.instrument.hardware_rig import HardwareRig
from greenough.instrument.hardware_settings import hardware_settings
from greenough.instrument.rigfile import load_rig_file
from greenough.twin.wire import lightcrafter
from greenough.twin.wire.emulated_rig import EmulatedRig
from greenough.twin.wire.gige_stream import FrameFault

SETTINGS = ("camera.rows=24", "camera.cols=32", "genicam.frame_timeout_s=60.0", "zaber.reply_timeout_s=60.0")
# Each pattern has a grey value of its own, which its frame shows.
PATTERNS = np.broadcast_to(10 * np.arange(1, 15, dtype=np.uint8)[:, None, None], (14, 684, 608))


class GreyScene:
    """Every frame has the grey value of its pattern; ``during`` is called with the number of each exposure."""

    def __init__(self) -> None:
        self.placed: list[Placement] = []
        self.during: Callable[[int], None] = lambda serial: None

    def place(self, placement: Placement) -> None:
        self.placed.append(placement)

    def move_to_mm(self, position: float) -> None:
        pass

    def expose(self, patterns, exposure_us, serial, began, lamp) -> np.ndarray:
        self.during(serial)
        grey = np.rint(lamp * patterns.mean(axis=(1, 2))).astype(np.uint8)
        return np.broadcast_to(grey[:, None, None], (len(patterns), 24, 32))


@pytest.fixture
def scene() -> GreyScene:
    return GreyScene()


@pytest.fixture
def emulated(scene: GreyScene) -> Iterator[EmulatedRig]:
    need_aravis()
    rig_file = load_rig_file("wire", [*SETTINGS, f'genicam.address="{free_address()}"'])
    with EmulatedRig(rig_file, scene, serial="SN-7", free_ports=True, homed=True) as opened:
        yield opened


def open_emulated(emulated: EmulatedRig, *settings: str, exposures_done: int = 0) -> HardwareRig:
    overrides = [*SETTINGS, f'genicam.address="{emulated.camera.host}"', *emulated.overrides, *settings]
    rig = open_rig("wire", overrides, exposures_done=exposures_done)
    assert isinstance(rig, HardwareRig)
    return rig


def test_more_patterns_than_the_memory_holds_come_back_in_their_order(emulated):
    with open_emulated(emulated, exposures_done=100) as rig:
        frames = rig.capture(PATTERNS)
        again = rig.capture(PATTERNS[:2])
    assert frames.stack[:, 0, 0].tolist() == PATTERNS[:, 0, 0].tolist()
    assert frames.serials.tolist() == list(range(100, 114))
    assert again.serials.tolist() == [114, 115]
    assert (np.diff([*frames.times_s, *again.times_s]) > 0).all()


def test_connecting_lights_and_moves_nothing_and_leaving_is_dark(emulated):
    before = emulated.stage.position
    with open_emulated(emulated) as rig:
        assert not emulated.projector.lit
        assert emulated.stage.position == before
        rig.projector.upload(PATTERNS[:2])
        rig.projector.start()
        assert emulated.projector.lit
    assert not emulated.projector.lit
    assert not emulated.stage.moves


def test_it_says_which_devices_answer(emulated):
    with open_emulated(emulated) as rig:
        projector, camera, stage = rig.devices
        assert rig.identity.camera_serial == "SN-7"
        assert rig.identity.projector_serial == "LightCrafter with DM365 4.0 (emulated)"
    assert (projector.role, camera.role, stage.role) == ("projector", "camera", "stage")
    assert "SN-7" in camera.identity
    assert stage.firmware == "7.38"


def test_exposures_are_those_that_camera_projector_and_rig_file_allow(emulated):
    with open_emulated(emulated, "lightcrafter.exposure_max_us=20_000", "camera.exposure_min_us=9000.0") as rig:
        assert rig.camera.exposure_limits_us == (9000.0, 20_000.0)
        with pytest.raises(InputError, match="outside its limits"):
            rig.camera.exposure_us = 20_001
        rig.camera.exposure_us = 12_000
        frames = rig.capture(PATTERNS[:1])
    assert frames.exposure_us == 12_000


def test_a_frame_that_fails_leaves_the_rig_dark_and_the_next_capture_is_whole(emulated):
    emulated.camera.frame_faults[13] = FrameFault("lost")
    with open_emulated(emulated, "genicam.frame_timeout_s=2.0") as rig:
        with pytest.raises(TimedOut, match="software trigger for frame 13"):
            rig.capture(PATTERNS)
        assert not emulated.projector.lit
        frames = rig.capture(PATTERNS)
    assert frames.stack[:, 0, 0].tolist() == PATTERNS[:, 0, 0].tolist()
    assert frames.serials[0] == 14, "an exposure that failed keeps its number"


def test_a_projector_that_fails_ends_the_capture_in_the_dark(emulated):
    with open_emulated(emulated) as rig:
        rig.capture(PATTERNS[:1])
        emulated.projector_server.faults = lightcrafter.at_request(9, lightcrafter.Fault.WRONG_CHECKSUM)
        with pytest.raises(DeviceError, match=r"projector at .*checksum"):
            rig.capture(PATTERNS)
        assert not emulated.projector.lit


def test_an_interrupt_ends_in_the_dark(emulated, scene, monkeypatch):
    with open_emulated(emulated) as rig:
        advance, calls = rig.projector.advance, iter(range(100))

        def interrupted() -> None:
            advance()
            if next(calls) == 4:
                raise KeyboardInterrupt

        monkeypatch.setattr(rig.projector, "advance", interrupted)
        with pytest.raises(KeyboardInterrupt):
            rig.capture(PATTERNS)
        assert not emulated.projector.lit
        monkeypatch.undo()
        assert rig.capture(PATTERNS).stack[:, 0, 0].tolist() == PATTERNS[:, 0, 0].tolist()


def test_a_stage_that_is_moved_during_a_capture_spoils_it(emulated, scene):
    scene.during = lambda serial: emulated.stage.turn_knob(-50) if serial == 12 else None
    with open_emulated(emulated) as rig, pytest.raises(DeviceError, match=r"it moved by -5 um; keep hands off"):
        rig.capture(PATTERNS)


def test_a_stage_without_reference_gives_no_frames(emulated, scene):
    with open_emulated(emulated) as rig:
        emulated.stage.switch_off_and_on()
        with pytest.raises(Fault, match="WR"):
            rig.capture(PATTERNS)
        assert not emulated.projector.lit
        assert emulated.camera.triggers == 0


def test_a_placement_reaches_the_bench(emulated, scene):
    with open_emulated(emulated) as rig:
        rig.operator.place(Placement("board", posture=3))
    assert scene.placed == [Placement("board", posture=3)]


def test_an_error_on_the_way_in_leaves_nothing_connected(emulated):
    with (
        pytest.raises(DeviceError, match=r"camera at 127\.255\.0\.9"),
        open_emulated(emulated, 'genicam.address="127.255.0.9"'),
    ):
        pass
    with open_emulated(emulated) as rig:  # nobody holds a device
        rig.capture(PATTERNS[:1])


def test_outside_its_context_there_is_no_camera(emulated):
    rig = open_emulated(emulated)
    with pytest.raises(RuntimeError, match="inside its context"):
        rig.capture(PATTERNS[:1])


@pytest.mark.parametrize(
    ("settings", "sentence"),
    [
        (["laser.power=1"], r"there is no field laser\.power"),
        (['lightcrafter.led="violet"'], r'lightcrafter.*led = "violet" must be "red", "green" or "blue"'),
        (["lightcrafter.led_current=-1"], "led_current = -1 must be a whole number from 0 to 65535"),
        (["zaber.microstep_um=0"], "microstep_um"),
        (['operator.address="nowhere"'], "address"),
        (['operator.address=""'], "operator.address is missing"),
        (["projector.rows=600"], "a LightCrafter has 684 and 608"),
        (["genicam.frame_timeout_s=0"], "frame_timeout_s"),
    ],
)
def test_a_wrong_rig_file_is_one_sentence(settings, sentence):
    with pytest.raises(InputError, match=sentence):
        open_rig("wire", settings)


@pytest.mark.parametrize("cameras", ["", "[genicam]\naddress = '10.0.0.1'\n[uvc]\ndevice = '/dev/video0'\n"])
def test_a_rig_has_one_camera(tmp_path, cameras):
    text = (load_text("paper").partition("[uvc]")[0]) + cameras
    (tmp_path / "rig.toml").write_text(text)
    with pytest.raises(InputError, match=r"has [02] cameras: give one of the sections \[genicam\] and \[uvc\]"):
        hardware_settings(load_rig_file(tmp_path / "rig.toml"))


def test_an_unknown_section_is_named(tmp_path):
    (tmp_path / "rig.toml").write_text(load_text("paper") + "[lightcraftr]\nhost = '10.0.0.1'\n")
    with pytest.raises(InputError, match=r"there is no section \[lightcraftr\]"):
        hardware_settings(load_rig_file(tmp_path / "rig.toml"))


@pytest.mark.parametrize("name", ["paper", "wire"])
def test_built_in_rigs_have_valid_sections(name):
    hardware_settings(load_rig_file(name))


@pytest.mark.parametrize("section", ["lightcrafter", "zaber", "uvc", "operator"])
def test_the_papers_rig_file_names_every_field(section):
    """But those of a remote operator, which it does not have."""
    settings = hardware_settings(load_rig_file("paper"))
    model = settings.camera if section == "uvc" else getattr(settings, section)
    missing = set(type(model).model_fields) - set(load_rig_file("paper").driver_section(section))
    assert missing <= {"address"}


def load_text(name: str) -> str:
    from importlib import resources

    return (resources.files("greenough.instrument") / "rigs" / f"{name}.toml").read_text()
