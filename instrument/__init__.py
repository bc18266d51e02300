"""The contract between measurement software and a profilometer, and what every rig shares."""

from typing import TYPE_CHECKING

from .load_on_use import load_on_use

if TYPE_CHECKING:
    from .contract import Frames as Frames
    from .contract import Placement as Placement
    from .errors import InputError as InputError
    from .opening import open_rig as open_rig

__all__ = ["Frames", "InputError", "Placement", "open_rig"]

load_on_use(__name__, {"Frames": "contract", "InputError": "errors", "Placement": "contract", "open_rig": "opening"})
