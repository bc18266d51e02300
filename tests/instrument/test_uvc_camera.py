"""UvcCamera over a substituted camera: its queue, its clock and its controls. No hardware was met."""

from collections import deque

import numpy as np
import pytest
from substituted_uvc import LIMITS

from greenough.instrument import uvc_camera, v4l2_controls
from greenough.instrument.device_errors import ConnectionLost, Fault, Rejected, TimedOut
from greenough.instrument.errors import InputError
from greenough.instrument.rigfile import CameraSection
from greenough.instrument.triggered_camera import CameraIdentity
from greenough.instrument.uvc_camera import UvcCamera, UvcSettings
from greenough.instrument.v4l2_capture import CapturedFrame

SHAPE = (6, 8)
SECTION = CameraSection(
    rows=6,
    cols=8,
    bits=8,
    full_well_e=6500,
    read_noise_e=10,
    black_level_dn=4,
    exposure_min_us=100,
    exposure_max_us=1e6,
)
SETTINGS = UvcSettings(device="/dev/video9", gain_db=3.5, readout_s=0.05)
STANDARD = {
    v4l2_controls.STANDARD_AUTO_EXPOSURE: (0, 3),
    v4l2_controls.STANDARD_EXPOSURE_100_US: (1, 300_000),
}


class FakeCamera:
    """A camera that sees ``pattern``: both layers in one, on a clock that only it moves.

    Freely running it exposes one frame after the other; ``delays_s`` are for the triggers to come, None for a trigger
    that it misses.
    """

    def __init__(self, controls=LIMITS):
        self.now_s = 100.0
        self.pattern = 0
        self.queue: deque[CapturedFrame] = deque()
        self.delays_s: deque[float | None] = deque()
        self.closed = 0
        self.commands: list[tuple[int, int]] = []
        self._known = controls
        self._values = dict.fromkeys(controls, 1)
        self._under_way: list[CapturedFrame] = []

    @property
    def exposure_s(self) -> float:
        in_us = self._values.get(v4l2_controls.EXPOSURE_US)
        return in_us / 1e6 if in_us is not None else self._values[v4l2_controls.STANDARD_EXPOSURE_100_US] / 1e4

    def frame(self, time_s: float) -> CapturedFrame:
        return CapturedFrame(np.full(SHAPE, self.pattern, np.uint8), time_s)

    def read(self, timeout_s):
        until_s = self.now_s + timeout_s
        if not self._values.get(v4l2_controls.TRIGGER_MODE, 0) and not self.queue:
            exposing = self.frame(self.now_s + self.exposure_s + SETTINGS.readout_s)
            self._under_way.append(exposing)
        for frame in sorted(self._under_way, key=lambda frame: frame.time_s):
            if frame.time_s <= until_s:
                self._under_way.remove(frame)
                self.queue.append(frame)
                break
        if not self.queue:
            self.now_s = until_s
            return None
        frame = self.queue.popleft()
        self.now_s = max(self.now_s, frame.time_s)
        return frame

    def identity(self):
        return CameraIdentity("The Imaging Source", "DMK 23U445", "1234", "1.0")

    def limits(self, control):
        return self._known.get(control)

    def get(self, control):
        return self._values[control]

    def set(self, control, value):
        assert control in self._known
        self.commands.append((control, value))
        self._values[control] = value
        if control == v4l2_controls.SOFTWARE_TRIGGER:
            delay_s = self.delays_s.popleft() if self.delays_s else 0.0
            if delay_s is not None:
                self._under_way.append(self.frame(self.now_s + self.exposure_s + 0.01 + delay_s))

    def close(self):
        self.closed += 1


@pytest.fixture
def fake(monkeypatch):
    return install(FakeCamera(), monkeypatch)


def install(fake, monkeypatch):
    monkeypatch.setattr(uvc_camera.time, "monotonic", lambda: fake.now_s)
    return fake


def open_camera(fake, **changes):
    return UvcCamera(SECTION, SETTINGS.model_copy(update=changes), fake, fake)


def test_frames_show_what_was_projected_when_they_were_asked_for(fake):
    with open_camera(fake) as camera:
        camera.exposure_us = 8333
        camera.arm()
        for serial, pattern in enumerate((3, 1, 4, 1, 5)):
            fake.pattern = pattern
            shot = camera.trigger_and_grab()
            assert (shot.image == pattern).all()
            assert shot.serial == serial


def test_buffers_from_before_the_trigger_are_passed_over(fake):
    with open_camera(fake) as camera:
        camera.arm()
        fake.pattern = 7
        fake.queue.extend(fake.frame(fake.now_s - age_s) for age_s in (0.3, 0.2, 0.1))
        fake.pattern = 8
        assert (camera.trigger_and_grab().image == 8).all()


def test_a_free_running_camera_never_gives_a_frame_whose_exposure_had_begun(monkeypatch):
    fake = install(FakeCamera(STANDARD), monkeypatch)
    with open_camera(fake, gain_db=0.0) as camera:
        camera.exposure_us = 20_000
        camera.arm()
        for pattern in range(1, 30):
            fake.queue.append(fake.frame(fake.now_s + 0.001 * pattern))  # under way: of the pattern before
            fake.pattern = pattern
            assert (camera.trigger_and_grab().image == pattern).all()


def test_a_frame_that_comes_too_late_is_an_error_and_never_the_next_frame(fake):
    with open_camera(fake) as camera:
        camera.arm()
        fake.pattern = 1
        fake.delays_s.append(SETTINGS.frame_timeout_s + 1)
        started_s = fake.now_s
        with pytest.raises(TimedOut, match=r"camera at /dev/video9: trigger for frame 0: the frame did not come"):
            camera.trigger_and_grab()
        assert fake.now_s - started_s <= camera.exposure_us / 1e6 + SETTINGS.frame_timeout_s + 1e-6
        with pytest.raises(RuntimeError, match="arm"):
            camera.trigger_and_grab()
        fake.pattern = 2
        camera.arm()
        assert (camera.trigger_and_grab().image == 2).all()


def test_a_trigger_that_the_camera_misses_is_an_error(fake):
    fake.delays_s.append(None)
    with open_camera(fake) as camera:
        camera.arm()
        with pytest.raises(TimedOut):
            camera.trigger_and_grab()


def test_a_camera_that_does_not_heed_its_trigger_mode_is_an_error(fake):
    with open_camera(fake) as camera:
        fake.queue.extend(fake.frame(fake.now_s) for _ in range(200))
        with pytest.raises(Fault, match="frames come without a trigger"):
            camera.arm()


@pytest.mark.parametrize(
    "image", [np.zeros((6, 9), np.uint8), np.zeros(SHAPE, np.uint16), np.zeros((6, 8, 3), np.uint8)]
)
def test_a_frame_of_another_size_or_type_is_an_error(fake, image):
    with open_camera(fake) as camera:
        camera.arm()
        fake.queue.append(CapturedFrame(image, fake.now_s + 1e-3))
        with pytest.raises(Fault, match="instead of uint8 of shape"):
            camera.trigger_and_grab()


def test_a_frame_by_another_clock_is_an_error_since_its_freshness_cannot_be_told(fake, monkeypatch):
    with open_camera(fake) as camera:
        camera.arm()
        monkeypatch.setattr(fake, "read", lambda _: fake.frame(fake.now_s + 1.7e9))  # seconds since 1970
        with pytest.raises(Fault, match="another clock"):
            camera.trigger_and_grab()


def test_exposure_and_gain_are_set_in_the_vendors_units_and_reported_as_taken(fake):
    with open_camera(fake) as camera:
        camera.exposure_us = 8333.4
        assert (v4l2_controls.EXPOSURE_US, 8333) in fake.commands
        assert camera.exposure_us == 8333
        assert (v4l2_controls.GAIN_CENTIBEL, 350) in fake.commands
        assert camera.gain_db == 3.5
        assert camera.exposure_limits_us == (100, 1e6)
    assert (v4l2_controls.AUTO_SHUTTER, 0) in fake.commands
    assert (v4l2_controls.GAIN_AUTO, 0) in fake.commands


def test_an_exposure_out_of_range_is_refused_before_anything_is_sent(fake):
    with open_camera(fake) as camera:
        sent = len(fake.commands)
        for value in (99.0, 1.1e6, float("nan")):
            with pytest.raises(InputError, match="100 to 1e\\+06 us"):
                camera.exposure_us = value
        assert len(fake.commands) == sent


def test_without_the_vendors_controls_exposures_are_whole_100_us_and_gain_stays(monkeypatch):
    fake = install(FakeCamera(STANDARD), monkeypatch)
    with open_camera(fake, gain_db=0.0) as camera:
        camera.exposure_us = 8333
        assert camera.exposure_us == 8300
        assert (v4l2_controls.STANDARD_AUTO_EXPOSURE, v4l2_controls.STANDARD_MANUAL) in fake.commands
    with pytest.raises(InputError, match=r"set uvc\.gain_db = 0"):
        open_camera(FakeCamera(STANDARD))


def test_a_camera_without_exposure_control_is_refused_and_let_go(monkeypatch):
    fake = install(FakeCamera({}), monkeypatch)
    with pytest.raises(InputError, match="no control of its exposure time"):
        open_camera(fake, gain_db=0.0)
    assert fake.closed == 2  # capture and controls


def test_closing_ends_trigger_mode_and_lets_go_once(fake):
    camera = open_camera(fake)
    camera.close()
    camera.close()
    assert fake.commands[-1] == (v4l2_controls.TRIGGER_MODE, 0)
    assert fake.closed == 2


def test_an_unplugged_camera_can_be_closed(fake, monkeypatch):
    camera = open_camera(fake)

    def gone(*_):
        raise ConnectionLost("camera", "set control", "No such device", "plug it in")

    monkeypatch.setattr(fake, "set", gone)
    camera.arm()
    with pytest.raises(ConnectionLost):
        camera.trigger_and_grab()
    camera.close()
    assert fake.closed == 2


def test_a_control_that_is_refused_names_device_and_command(tmp_path):
    plain = tmp_path / "video"
    plain.touch()
    controls = v4l2_controls.V4l2Controls(str(plain))  # a file takes none of a camera's ioctls
    with pytest.raises(Rejected, match=r"camera at .*video: set control 0x199e201 to 8333: rejected with ENOTTY"):
        controls.set(v4l2_controls.EXPOSURE_US, 8333)
    assert controls.limits(v4l2_controls.EXPOSURE_US) is None
    controls.close()


def test_controls_go_out_as_the_kernel_lays_them_out(monkeypatch, tmp_path):
    """Requests and bytes as <linux/videodev2.h> has them: v4l2_control is id and value, 4 bytes each."""
    sent = []
    monkeypatch.setattr(v4l2_controls.fcntl, "ioctl", lambda _, request, data: sent.append((request, bytes(data))))
    (tmp_path / "video").touch()
    controls = v4l2_controls.V4l2Controls(str(tmp_path / "video"))
    controls.set(v4l2_controls.EXPOSURE_US, 8333)
    controls.get(v4l2_controls.GAIN_CENTIBEL)
    controls.limits(v4l2_controls.TRIGGER_MODE)
    controls.identity()
    controls.close()
    little = [request.to_bytes(4, "little") for request in (0x199E201, 8333, 0x199E204, 0, 0x199E208)]
    assert sent[0] == (0xC008561C, little[0] + little[1])
    assert sent[1] == (0xC008561B, little[2] + little[3])
    assert sent[2] == (0xC0445624, little[4] + bytes(64))
    assert sent[3] == (0x80685600, bytes(104))


def test_a_device_file_that_is_missing_is_one_sentence():
    with pytest.raises(ConnectionLost, match="camera at /dev/video4711: open: no connection"):
        uvc_camera.open_uvc_camera(SECTION, SETTINGS.model_copy(update={"device": "/dev/video4711"}))
