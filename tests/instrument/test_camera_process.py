"""A camera in a process of its own is the same camera, and its end is an error."""

import multiprocessing
import os
import signal
from functools import partial

import numpy as np
import pytest
from aborting_camera import AbortingCamera, refuse
from emulated_gige import SHAPE, emulated, need_aravis, picture, section

from greenough.instrument.camera_process import CameraProcess
from greenough.instrument.device_errors import ConnectionLost, Fault, TimedOut
from greenough.instrument.errors import InputError
from greenough.instrument.genicam_camera import GenicamCamera, GenicamSettings
from greenough.twin.wire.gige_camera import Trigger
from greenough.twin.wire.gige_stream import FrameFault


def test_frames_settings_and_errors_are_those_of_the_camera():
    need_aravis()
    with emulated() as wire:
        settings = GenicamSettings(address=wire.host, frame_timeout_s=60.0)
        name = f"camera at {wire.host}"
        with CameraProcess(partial(GenicamCamera, section(), settings), name, 60.0) as camera:
            assert (camera.shape, camera.full_scale_dn, camera.identity.serial) == (SHAPE, 255.0, "SN-42")
            camera.exposure_us = 8333.25
            assert camera.exposure_us == 8333.25
            with pytest.raises(InputError, match="exposure time"):
                camera.exposure_us = 1.0
            camera.arm()
            for number in range(3):
                shot = camera.trigger_and_grab()
                assert np.array_equal(shot.image, picture(Trigger(number, 0, 0)))
                assert shot.serial == number
            wire.frame_faults[3] = FrameFault("number_skipped")
            with pytest.raises(Fault, match="frames lost") as raised:
                camera.trigger_and_grab()
            assert raised.value.device == name
        camera.close()
    assert not multiprocessing.active_children()


def test_the_end_of_its_process_is_an_error_and_can_be_closed():
    camera = CameraProcess(AbortingCamera, "camera at nowhere", 1.0)
    camera.arm()
    for _ in range(2):
        with pytest.raises(ConnectionLost, match=r"camera at nowhere: trigger_and_grab: .*its process ended with -6"):
            camera.trigger_and_grab()
    camera.close()
    assert not multiprocessing.active_children()


def test_a_camera_that_cannot_be_opened_says_so_here():
    with pytest.raises(ConnectionLost, match=r"camera at 127\.255\.0\.1: connect"):
        CameraProcess(partial(refuse, "127.255.0.1"), "camera", 1.0)
    assert not multiprocessing.active_children()


def test_a_process_that_hangs_is_ended_and_told(monkeypatch):
    camera = CameraProcess(AbortingCamera, "camera at nowhere", 1.0)
    monkeypatch.setattr("greenough.instrument.camera_process._COMMAND_TIMEOUT_S", 1.0)
    (process,) = multiprocessing.active_children()
    os.kill(process.pid, signal.SIGSTOP)
    with pytest.raises(TimedOut, match=r"camera at nowhere: arm: an answer did not come within 1 s; see to its power"):
        camera.arm()
    camera.close()
    assert not multiprocessing.active_children()


def test_an_interrupted_answer_is_not_taken_up_again_and_lets_go_of_the_camera(monkeypatch):
    """What is left of it would be read as the beginning of the next one."""
    need_aravis()
    with emulated() as wire:
        settings = GenicamSettings(address=wire.host, frame_timeout_s=60.0)
        camera = CameraProcess(partial(GenicamCamera, section(), settings), "camera", 60.0)

        def interrupted():
            os.read(camera._connection.fileno(), 2)
            raise KeyboardInterrupt

        with monkeypatch.context() as patched:
            patched.setattr(camera._connection, "recv", interrupted)
            with pytest.raises(KeyboardInterrupt):
                camera.arm()
        with pytest.raises(ConnectionLost, match="it was closed or interrupted"):
            camera.disarm()
        camera.close()
        assert not multiprocessing.active_children()
        assert not wire.is_controlled


def test_a_terminated_process_lets_go_of_the_camera():
    need_aravis()
    with emulated() as wire:
        settings = GenicamSettings(address=wire.host, frame_timeout_s=60.0)
        with CameraProcess(partial(GenicamCamera, section(), settings), "camera", 60.0) as camera:
            camera.arm()
            assert wire.is_controlled
            (process,) = multiprocessing.active_children()
            process.terminate()
            process.join()
            assert not wire.is_controlled
            with pytest.raises(ConnectionLost, match=f"its process ended with {128 + signal.SIGTERM}"):
                camera.trigger_and_grab()


def test_an_interrupt_while_its_process_is_started_leaves_no_socket(monkeypatch):
    def sockets() -> set[str]:
        names = (os.path.realpath(f"/proc/self/fd/{number}") for number in os.listdir("/proc/self/fd"))
        return {name for name in names if "socket:" in name}

    def interrupted(process) -> None:
        raise KeyboardInterrupt

    before = sockets()
    monkeypatch.setattr("multiprocessing.context.SpawnProcess.start", interrupted)
    with pytest.raises(KeyboardInterrupt) as raised:  # whose traceback keeps all that was made
        CameraProcess(AbortingCamera, "camera at nowhere", 1.0)
    assert raised.tb
    assert sockets() == before
