"""Measurement software: patterns to phase, calibration, reconstruction, comparison, files.

It knows a rig only by the contract of ``greenough.instrument``.
"""

from .calibration import Calibration
from .decode import PhaseMap, decode
from .fringes import FringeSet
from .reconstruct import PointMap, reconstruct

__all__ = ["Calibration", "FringeSet", "PhaseMap", "PointMap", "decode", "reconstruct"]
