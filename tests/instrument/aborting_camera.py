"""Cameras for another process: one whose library ends it, and one that is not there."""

import os

from greenough.instrument.contract import CameraNoise
from greenough.instrument.device_errors import ConnectionLost
from greenough.instrument.triggered_camera import CameraIdentity


class AbortingCamera:
    identity = CameraIdentity("nobody", "aborting", "1", "1")
    shape = (2, 3)
    full_scale_dn = 255.0
    black_level_dn = 0.0
    noise = CameraNoise(1000.0, 1.0, 4.0)
    gain_db = 0.0
    exposure_limits_us = (1.0, 1000.0)
    exposure_us = 100.0

    def arm(self) -> None: ...

    def trigger_and_grab(self):
        os.abort()

    def disarm(self) -> None: ...

    def close(self) -> None: ...


def refuse(address: str) -> AbortingCamera:
    raise ConnectionLost(f"camera at {address}", "connect", "nothing is there", "plug it in")
