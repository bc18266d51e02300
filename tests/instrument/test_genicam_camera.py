"""GenicamCamera through Aravis against the emulated camera, over UDP on loopback."""

import os
import random
from dataclasses import replace
from pathlib import Path

import emulated_gige
import numpy as np
import pytest
from emulated_gige import MODEL, SHAPE, emulated, picture, section

from greenough.instrument import aravis, genicam_camera
from greenough.instrument.device_errors import ConnectionLost, DeviceError, Fault, TimedOut
from greenough.instrument.errors import InputError
from greenough.instrument.genicam_camera import GenicamCamera, GenicamSettings
from greenough.twin.wire.gige_camera import GigeCamera, Trigger
from greenough.twin.wire.gige_stream import FrameFault

PATIENT_S = 60.0  # for frames that come: however busy the machine is
SHORT_S = 0.8  # for frames that do not


@pytest.fixture(autouse=True)
def _installed():
    emulated_gige.need_aravis()


def connect(camera: GigeCamera, timeout_s: float = PATIENT_S, **changes) -> GenicamCamera:
    first = {name: changes.pop(name) for name in ("first_row", "first_col", "gain_db") if name in changes}
    return GenicamCamera(section(**changes), GenicamSettings(address=camera.host, frame_timeout_s=timeout_s, **first))


def test_frames_come_bit_by_bit_and_in_the_order_of_their_triggers():
    with emulated() as wire, connect(wire) as camera:
        camera.arm()
        for number in range(20):
            shot = camera.trigger_and_grab()
            assert np.array_equal(shot.image, picture(Trigger(number, 0, 0)))
            assert shot.serial == number
        assert wire.triggers == 20


def test_frames_of_a_whole_sensor_come_bit_by_bit():
    shape = (960, 1280)
    with (
        emulated(replace(MODEL, shape=shape), lambda trigger: picture(trigger, shape)) as wire,
        connect(wire, rows=960, cols=1280) as camera,
    ):
        camera.arm()
        for number in range(3):
            assert np.array_equal(camera.trigger_and_grab().image, picture(Trigger(number, 0, 0), shape))


def test_a_region_is_that_part_of_the_picture():
    with emulated() as wire, connect(wire, rows=16, cols=20, first_row=5, first_col=11) as camera:
        camera.arm()
        assert np.array_equal(camera.trigger_and_grab().image, picture(Trigger(0, 0, 0))[5:21, 11:31])


@pytest.mark.parametrize(("pixel_format", "full_scale_dn"), [("Mono16", 65535), ("Mono12", 4095)])
def test_deeper_pixels_come_as_whole_grey_values(pixel_format, full_scale_dn):
    def deep(trigger):
        return picture(trigger, dtype=np.uint16) >> (4 if pixel_format == "Mono12" else 0)

    with emulated(replace(MODEL, pixel_format=pixel_format), deep) as wire, connect(wire, bits=16) as camera:
        camera.arm()
        assert np.array_equal(camera.trigger_and_grab().image, deep(Trigger(0, 0, 0)))
        assert camera.full_scale_dn == full_scale_dn
        assert camera.noise.electrons_per_dn == pytest.approx(6500 / (full_scale_dn - 4))


def test_exposure_and_gain_reach_the_source_of_the_pictures_as_they_were_set():
    seen = []

    def source(trigger):
        seen.append(trigger)
        return picture(trigger)

    exposures = [100.0, 8333.25, 1e6, 123456.789]
    with emulated(source=source) as wire, connect(wire, gain_db=6.5) as camera:
        camera.arm()
        for value in exposures:
            camera.exposure_us = value
            assert camera.exposure_us == value
            camera.trigger_and_grab()
        assert camera.gain_db == 6.5
    assert [(trigger.exposure_us, trigger.gain_db) for trigger in seen] == [(value, 6.5) for value in exposures]


def test_the_camera_says_who_it_is_and_what_it_can():
    with emulated() as wire, connect(wire, exposure_min_us=1.0) as camera:
        identity = camera.identity
        assert (identity.vendor, identity.model) == ("Greenough", "Emulated & <tested>")
        assert (identity.serial, identity.firmware) == ("SN-42", "1.2.3")
        assert camera.exposure_limits_us == (20.0, 1e6)  # of the camera and of the rig file
        assert camera.shape == SHAPE


def test_an_exposure_out_of_range_is_refused_before_anything_is_sent():
    with emulated() as wire, connect(wire) as camera:
        wire.silent = True  # nothing would come back
        with pytest.raises(InputError, match="100 to 1e\\+06 us"):
            camera.exposure_us = 2e6
        wire.silent = False


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"bits": 16}, r"offers the pixel formats Mono8, and camera.bits = 16 asks for Mono16 or Mono12 or Mono10"),
        ({"gain_db": 20.0}, r"gain of 20 dB is outside its limits, 0 to 12 dB"),
        ({"rows": 49}, r"set the region to 64 x 49 from column 0, row 0: rejected"),
        ({"first_col": 1}, r"set the region to 64 x 48 from column 1, row 0: rejected"),
        ({"exposure_min_us": 3e6, "exposure_max_us": 4e6}, r"takes exposure times from 20 to 2e\+06 us"),
    ],
)
def test_what_the_camera_cannot_do_is_one_sentence(changes, sentence):
    with emulated() as wire, pytest.raises(InputError, match=sentence):
        connect(wire, **changes)


def test_lost_packets_are_asked_for_again():
    with emulated() as wire, connect(wire) as camera:
        wire.frame_faults.update({n: FrameFault("packets_lost", share=share) for n, share in enumerate((0.1, 0.6, 1))})
        camera.arm()
        for number in range(4):
            assert np.array_equal(camera.trigger_and_grab().image, picture(Trigger(number, 0, 0)))


def test_packets_that_are_asked_for_again_are_of_the_acquisition_that_runs():
    """Its blocks are numbered anew: those of the one before have the same numbers."""
    with emulated() as wire, connect(wire) as camera:
        wire.frame_faults[1] = FrameFault("packets_lost", share=0.5)
        for number in range(2):
            camera.arm()
            assert np.array_equal(camera.trigger_and_grab().image, picture(Trigger(number, 0, 0)))
            camera.disarm()


@pytest.mark.parametrize("kind", ["sent_twice", "untriggered"])
def test_frames_that_nobody_asked_for_are_passed_over(kind):
    with emulated() as wire, connect(wire) as camera:
        wire.frame_faults.update({number: FrameFault(kind) for number in range(0, 8, 2)})
        camera.arm()
        for number in range(8):
            assert np.array_equal(camera.trigger_and_grab().image, picture(Trigger(number, 0, 0)))


@pytest.mark.timeout(300)
@pytest.mark.parametrize(
    ("fault", "error", "sentence"),
    [
        (FrameFault("lost"), TimedOut, "the frame did not come within"),
        (FrameFault("late", delay_s=2 * SHORT_S), TimedOut, "the frame did not come within"),
        # Whether an incomplete frame is handed out as such or kept back is up to Aravis' version.
        (
            FrameFault("packets_lost", share=0.3, for_good=True),
            (Fault, TimedOut),
            "(buffer status|the frame did not come within)",
        ),
    ],
)
def test_a_frame_that_does_not_come_whole_and_in_time_is_an_error_and_never_the_next_frame(fault, error, sentence):
    with emulated() as wire, connect(wire, SHORT_S) as camera:
        wire.frame_faults[0] = fault
        camera.arm()
        with pytest.raises(error, match=f"camera at {wire.host}: software trigger for frame 0: .*{sentence}") as raised:
            camera.trigger_and_grab()
        if isinstance(raised.value, TimedOut):
            assert raised.value.timeout_s == pytest.approx(camera.exposure_us / 1e6 + SHORT_S)
        with pytest.raises(RuntimeError, match="arm"):
            camera.trigger_and_grab()
    with emulated(source=lambda trigger: picture(trigger)) as wire, connect(wire) as camera:
        wire.frame_faults[0] = FrameFault("late", delay_s=SHORT_S)
        camera.arm()
        camera._aravis("arv_camera_software_trigger", camera._camera)  # as a trigger that was given up
        camera.arm()
        assert np.array_equal(camera.trigger_and_grab().image, picture(Trigger(1, 0, 0)))


def test_a_frame_that_is_missing_in_the_count_is_an_error():
    with emulated() as wire, connect(wire) as camera:
        wire.frame_faults[2] = FrameFault("number_skipped")
        camera.arm()
        camera.trigger_and_grab()
        camera.trigger_and_grab()
        with pytest.raises(Fault, match=r"frames lost.*block 4 came after block 2"):
            camera.trigger_and_grab()
        camera.arm()
        assert np.array_equal(camera.trigger_and_grab().image, picture(Trigger(3, 0, 0)))


class Substituted:
    """Aravis with another answer to one of its functions."""

    def __init__(self, original: aravis.Aravis, function: str, answer: int):
        self._original, self._function, self._answer = original, function, answer

    def __call__(self, name, *arguments):
        return self._answer if name == self._function else self._original(name, *arguments)

    def __getattr__(self, name):
        return getattr(self._original, name)


@pytest.mark.parametrize(
    ("function", "answer", "sentence"),
    [
        *(("arv_buffer_get_status", status, meaning) for status, meaning in aravis.STATUS_NAMES.items()),
        ("arv_buffer_get_status", -1, "unknown"),
        ("arv_buffer_get_image_width", SHAPE[1] - 1, "not the frame that was set"),
        ("arv_buffer_get_image_pixel_format", aravis.PIXEL_FORMATS["Mono16"], "not the frame that was set"),
    ],
)
def test_a_buffer_that_is_not_whole_or_not_as_set_is_an_error(function, answer, sentence):
    with emulated() as wire, connect(wire) as camera:
        camera._aravis = Substituted(camera._aravis, function, answer)
        camera.arm()
        with pytest.raises(Fault, match=sentence):
            camera.trigger_and_grab()


def test_whatever_happens_to_frames_no_other_is_ever_taken_for_them():
    """Faults at random triggers; the seed is the same, when which of them fails is up to the machine."""
    rng = random.Random(3)
    kinds = ("late", "lost", "sent_twice", "untriggered", "number_skipped", "packets_lost")
    with emulated() as wire:
        for number in range(60):
            if rng.random() < 0.3:
                wire.frame_faults[number] = FrameFault(rng.choice(kinds), 0.2 * rng.random(), 0.3, rng.random() < 0.5)
        with connect(wire, timeout_s=0.15) as camera:
            armed = False
            for _ in range(60):
                if not armed:
                    camera.arm()
                    armed = True
                asked = wire.triggers
                try:
                    shot = camera.trigger_and_grab()
                except DeviceError:
                    armed = False
                    continue
                assert np.array_equal(shot.image, picture(Trigger(asked, 0, 0)))
        wire.frame_faults.clear()
        with connect(wire) as camera:  # on a busy machine all the others may have been too late
            camera.arm()
            asked = wire.triggers
            assert np.array_equal(camera.trigger_and_grab().image, picture(Trigger(asked, 0, 0)))


@pytest.mark.timeout(120)
def test_silence_is_an_error_within_the_stated_time():
    with emulated() as wire, connect(wire, SHORT_S) as camera:
        camera.arm()
        wire.silent = True
        told = f"camera at {wire.host}: software trigger for frame 0: an answer did not come within "
        with pytest.raises(TimedOut, match=f"{told}{aravis.REPLY_TIMEOUT_S:g} s"):
            camera.trigger_and_grab()
        wire.silent = False


def test_a_camera_that_is_not_there_is_one_sentence():
    with pytest.raises(ConnectionLost, match=r"camera at 127\.255\.0\.1: connect: no connection"):
        GenicamCamera(section(), GenicamSettings(address="127.255.0.1"))


def test_a_camera_that_another_program_has_is_one_sentence():
    with emulated() as wire, connect(wire), pytest.raises(ConnectionLost, match="no other program has it"):
        connect(wire)


def test_nothing_is_left_after_close():
    def held() -> tuple[int, set[str]]:
        return len(os.listdir("/proc/self/task")), {
            os.readlink(path) for path in Path("/proc/self/fd").iterdir() if path.is_symlink() and path.exists()
        }

    def cycle() -> None:
        with emulated() as wire, connect(wire) as camera:
            camera.arm()
            camera.trigger_and_grab()

    cycle()  # what the library keeps for good is made once
    before = held()
    cycle()
    after = held()
    assert after[0] <= before[0]
    assert after[1] <= before[1]


def test_without_aravis_there_is_one_sentence_with_the_remedy(monkeypatch):
    monkeypatch.setattr(aravis, "find_libraries", lambda: ())
    aravis.load.cache_clear()
    try:
        with pytest.raises(InputError, match=r"apt-get install libaravis-0.8-0.*pip install greenough\[genicam\]"):
            genicam_camera.GenicamCamera(section(), GenicamSettings(address="127.0.0.1"))
    finally:
        aravis.load.cache_clear()


def test_what_aravis_lacks_is_named_with_its_package(monkeypatch):
    """On a machine without GLib, and whatever the operating system has besides."""
    monkeypatch.setattr(aravis, "find_libraries", lambda: ("libnowhere.so.1",))
    monkeypatch.setattr(aravis, "_loads", lambda library: "glib" not in library)
    aravis.load.cache_clear()
    try:
        with pytest.raises(InputError, match=r'lacks libglib-2\.0\.so\.0: run "apt-get install libglib2\.0-0" \('):
            aravis.load()
    finally:
        aravis.load.cache_clear()


def test_an_aravis_that_does_not_load_does_not_hide_the_next(monkeypatch, tmp_path):
    broken = tmp_path / "libaravis-0.8.so"
    broken.write_bytes(b"no library")
    installed = aravis.find_libraries()
    monkeypatch.setattr(aravis, "find_libraries", lambda: (str(broken), *installed))
    aravis.load.cache_clear()
    try:
        assert aravis.load()
    finally:
        aravis.load.cache_clear()


def test_an_aravis_that_lacks_nothing_but_is_broken_says_what_the_linker_says(monkeypatch, tmp_path):
    broken = tmp_path / "libaravis-0.8.so"
    broken.write_bytes(b"no library")
    monkeypatch.setattr(aravis, "find_libraries", lambda: (str(broken),))
    aravis.load.cache_clear()
    try:
        with pytest.raises(InputError, match=r"libaravis-0.8.so: (file too short|invalid ELF header)"):
            aravis.load()
    finally:
        aravis.load.cache_clear()
