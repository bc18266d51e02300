"""The digital twin: a profilometer made of lenses and a renderer, behind the same contract as the real one.

``open`` gives the rig and, beside it, the bench that knows the truth; ``scene_dict`` is the Mitsuba scene. Mitsuba is
loaded when one of the names is first used.
"""

from typing import TYPE_CHECKING

from greenough.instrument.load_on_use import load_on_use

if TYPE_CHECKING:
    from .bench import Bench as Bench
    from .bench import Truth as Truth
    from .rig import TwinRig as TwinRig
    from .rig import open as open
    from .rig import open_rig as open_rig
    from .rig import scene_dict as scene_dict

__all__ = ["Bench", "Truth", "TwinRig", "open", "open_rig", "scene_dict"]

load_on_use(
    __name__,
    {"Bench": "bench", "Truth": "bench", "TwinRig": "rig", "open": "rig", "open_rig": "rig", "scene_dict": "rig"},
)
