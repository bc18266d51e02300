"""An emulated GigE Vision camera for tests: small pictures that name their trigger, at an address of its own."""

import itertools
import os
import time

import numpy as np
import pytest

from greenough.instrument.aravis import find_libraries, load
from greenough.instrument.errors import InputError
from greenough.instrument.rigfile import CameraSection
from greenough.twin.wire.gige_camera import GigeCamera, Trigger
from greenough.twin.wire.gige_registers import CameraModel

SHAPE = (48, 64)
MODEL = CameraModel("Greenough", "Emulated & <tested>", "SN-42", "1.2.3", SHAPE, (20.0, 2e6), (0.0, 12.0))

_counter = itertools.count(1)


def free_address() -> str:
    """A loopback address that no other process and no other test uses."""
    pid = os.getpid()
    return f"127.{1 + (pid >> 8) % 254}.{pid & 0xFF}.{1 + next(_counter) % 254}"


def picture(trigger: Trigger, shape: tuple[int, int] = SHAPE, dtype=np.uint8) -> np.ndarray:
    """Noise that depends on the trigger's number alone."""
    rng = np.random.default_rng(trigger.number)
    return rng.integers(0, np.iinfo(dtype).max, shape, dtype, endpoint=True)


def section(**changes) -> CameraSection:
    fields = {
        "rows": SHAPE[0],
        "cols": SHAPE[1],
        "bits": 8,
        "full_well_e": 6500.0,
        "read_noise_e": 10.0,
        "black_level_dn": 4.0,
        "exposure_min_us": 100.0,
        "exposure_max_us": 1e6,
    }
    return CameraSection(**{**fields, **changes})


def emulated(model: CameraModel = MODEL, source=picture) -> GigeCamera:
    return GigeCamera(model, source, free_address())


def serve(address: str, ready) -> None:
    """A camera in a process of its own; ``ready`` is set when it can be reached."""
    with GigeCamera(MODEL, picture, address):
        ready.set()
        time.sleep(600)


def need_aravis(libraries: int = 1) -> None:
    """Skip where fewer versions of Aravis are installed, or none loads; fail where GREENOUGH_NEEDS_ARAVIS says so."""
    found = len(find_libraries())
    try:
        load()
        reason = "" if found >= libraries else f"{found} of {libraries} Aravis found: apt-get install aravis-tools-cli"
    except InputError as error:
        reason = str(error)
    if reason:
        if libraries <= int(os.environ.get("GREENOUGH_NEEDS_ARAVIS", "0")):
            pytest.fail(reason)
        pytest.skip(reason)
