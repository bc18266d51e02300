"""A camera in a process of its own is the same camera, and its end is an error."""

import multiprocessing
from functools import partial

import numpy as np
import pytest
from aborting_camera import AbortingCamera, refuse
from emulated_gige import SHAPE, emulated, need_aravis, picture, section

from greenough.instrument.camera_process import CameraProcess
from greenough.instrument.device_errors import ConnectionLost, Fault
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
