"""The contract between measurement software and a profilometer, and what every rig shares."""

from .contract import Frames, Placement
from .errors import InputError
from .opening import open_rig

__all__ = ["Frames", "InputError", "Placement", "open_rig"]
