"""What a rig needs of a real camera beyond the contract: frames one by one, each exposed after it was asked for."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from .contract import Camera, CameraNoise
from .errors import InputError
from .rigfile import CameraSection


@dataclass(frozen=True)
class CameraIdentity:
    """Which camera this is, as it says itself; empty where it does not say."""

    vendor: str
    model: str
    serial: str
    firmware: str


@dataclass(frozen=True)
class Shot:
    """One frame.

    Parameters
    ----------
    image : (rows, cols) uint8 or uint16
        A copy of its own.
    serial : int
        Of the frames that were delivered since the camera was opened, from 0.
    time_s : float
        When it was triggered: ``time.monotonic()``. Its exposure began no earlier.
    """

    image: np.ndarray
    serial: int
    time_s: float


class TriggeredCamera(Camera, Protocol):
    """A camera that waits for a trigger. Whatever it raises as a DeviceError leaves it disarmed."""

    @property
    def identity(self) -> CameraIdentity: ...

    @property
    def gain_db(self) -> float: ...

    def arm(self) -> None:
        """Make ready for triggers; frames that are still under way from before are forgotten."""
        ...

    def trigger_and_grab(self) -> Shot:
        """Expose one frame from now on and wait for it.

        Raises
        ------
        DeviceError
            When it does not come in time, or is damaged, or is not the one that was asked for.
        """
        ...

    def disarm(self) -> None:
        """Take no more frames."""
        ...

    def close(self) -> None:
        """Disarm and let go of the camera; a second call does nothing."""
        ...


def noise_of(section: CameraSection, full_scale_dn: float) -> CameraNoise:
    """The data sheet's noise for a camera that clips at ``full_scale_dn``: a full well fills the grey values to it."""
    return CameraNoise(
        full_well_e=section.full_well_e,
        read_noise_e=section.read_noise_e,
        electrons_per_dn=section.full_well_e / (full_scale_dn - section.black_level_dn),
    )


def joint_limits_us(section: CameraSection, device_us: tuple[float, float], device: str) -> tuple[float, float]:
    """Exposure times that both the rig file and the camera allow; InputError where there are none."""
    low = max(section.exposure_min_us, device_us[0])
    high = min(section.exposure_max_us, device_us[1])
    if low > high:
        raise InputError(
            f"{device} takes exposure times from {device_us[0]:g} to {device_us[1]:g} us, the rig file allows "
            f"{section.exposure_min_us:g} to {section.exposure_max_us:g} us: change camera.exposure_min_us and "
            "exposure_max_us."
        )
    return low, high
