"""The samples that a rig knows by name."""

from collections.abc import Callable, Mapping
from functools import partial
from types import MappingProxyType

from greenough.instrument.errors import InputError

from .bga import bga, defective_bga
from .chirp import chirp
from .coin import coin
from .cross_grating import cross_grating
from .diaphragm import DEFLECTION_MM, diaphragm
from .parts import Specimen
from .plane import plane
from .spheres import sphere, two_spheres
from .step_gauge import step_gauge

_MAKERS: Mapping[str, Callable[[int], Specimen]] = MappingProxyType(
    {
        "plane": lambda _: plane(),
        "coin": lambda _: coin(),
        "bga": bga,
        **{f"diaphragm-{state}": partial(lambda state, _: diaphragm(state), state) for state in DEFLECTION_MM},
        "bga-defective": defective_bga,
        "sphere": sphere,
        "two-spheres": two_spheres,
        "step-gauge": step_gauge,
        "cross-grating": cross_grating,
        "chirp": lambda _: chirp(),
    }
)

NAMES = tuple(_MAKERS)

FLAT = ("plane", "cross-grating")
"""Those without relief: no part of them lights another."""


def specimen(name: str, seed: int) -> Specimen:
    """The sample ``name``, one of :data:`NAMES`; what varies from one to the next is drawn from ``seed``.

    Raises
    ------
    InputError
        If there is no such sample.
    """
    if name not in _MAKERS:
        raise InputError(f"unknown sample {name!r}; choose one of {', '.join(NAMES)}")
    return _MAKERS[name](seed)
