"""The samples that a rig knows by name."""

from greenough.instrument.errors import InputError

from .bga import bga
from .coin import coin
from .diaphragm import DEFLECTION_MM, diaphragm
from .parts import Specimen
from .plane import plane

NAMES = ("plane", "coin", "bga", *(f"diaphragm-{state}" for state in DEFLECTION_MM))


def specimen(name: str, seed: int) -> Specimen:
    """The sample ``name``, one of :data:`NAMES`; what varies from one to the next is drawn from ``seed``.

    Raises
    ------
    InputError
        If there is no such sample.
    """
    if name == "plane":
        return plane()
    if name == "coin":
        return coin()
    if name == "bga":
        return bga(seed)
    part, _, state = name.partition("-")
    if part == "diaphragm" and state in DEFLECTION_MM:
        return diaphragm(state)
    raise InputError(f"unknown sample {name!r}; choose one of {', '.join(NAMES)}.")
