"""Measurement software: patterns to phase, calibration, reconstruction, comparison, files.

It knows a rig only by the contract of ``greenough.instrument``.
"""

from typing import TYPE_CHECKING

from greenough.instrument.load_on_use import load_on_use

if TYPE_CHECKING:
    from .assert_matches_mesh import assert_matches_mesh as assert_matches_mesh
    from .calibration import Calibration as Calibration
    from .decode import PhaseMap as PhaseMap
    from .decode import decode as decode
    from .fringes import FringeSet as FringeSet
    from .reconstruct import PointMap as PointMap
    from .reconstruct import reconstruct as reconstruct

__all__ = ["Calibration", "FringeSet", "PhaseMap", "PointMap", "assert_matches_mesh", "decode", "reconstruct"]

load_on_use(
    __name__,
    {
        "Calibration": "calibration",
        "FringeSet": "fringes",
        "PhaseMap": "decode",
        "PointMap": "reconstruct",
        "assert_matches_mesh": "assert_matches_mesh",
        "decode": "decode",
        "reconstruct": "reconstruct",
    },
)
