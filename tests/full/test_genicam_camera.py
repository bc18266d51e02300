"""A GenICam camera that is gone in the middle of its work: what Aravis gives up after long time-outs."""

import multiprocessing

import numpy as np
import pytest
from emulated_gige import free_address, need_aravis, picture, section, serve

from greenough.instrument.device_errors import ConnectionLost, TimedOut
from greenough.instrument.genicam_camera import GenicamCamera, GenicamSettings
from greenough.twin.wire.gige_camera import Trigger

pytestmark = pytest.mark.full
PATIENT_S = 60.0


def test_a_camera_whose_process_is_killed_is_an_error_and_can_be_closed():
    need_aravis()
    context = multiprocessing.get_context("spawn")
    ready = context.Event()
    address = free_address()
    process = context.Process(target=serve, args=(address, ready), daemon=True)
    process.start()
    try:
        assert ready.wait(PATIENT_S)
        camera = GenicamCamera(section(), GenicamSettings(address=address, frame_timeout_s=PATIENT_S))
        camera.arm()
        assert np.array_equal(camera.trigger_and_grab().image, picture(Trigger(0, 0, 0)))
        process.kill()
        process.join()
        with pytest.raises((TimedOut, ConnectionLost), match=f"camera at {address}: software trigger for frame 1"):
            camera.trigger_and_grab()
        camera.close()
    finally:
        process.kill()
        process.join()
        process.close()
