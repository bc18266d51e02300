"""The twin as what lies before emulated devices."""

import numpy as np

from greenough.instrument.contract import Placement
from greenough.instrument.rigfile import RigFile

from ..rig import TwinRig
from ..settings import twin_settings
from ..workbench import Workbench


class TwinScene:
    """A ``Scene`` that is rendered: the frames of ``greenough.twin`` for the same seed and run, to the last bit.

    Parameters
    ----------
    rig_file : RigFile
        Of any driver; ``[twin]`` says what is rendered.
    run : str
        Whose noise and drifts the exposures have.

    Raises
    ------
    InputError
        For wrong fields of ``[twin]``.
    """

    def __init__(self, rig_file: RigFile, run: str = "default"):
        self._workbench = Workbench(rig_file, twin_settings(rig_file))
        self._rig = TwinRig(rig_file, self._workbench, run, exposures_done=0)

    @property
    def camera_serial(self) -> str:
        return self._rig.identity.camera_serial

    def place(self, placement: Placement) -> None:
        """Mount a part. Raises InputError for one that is not known."""
        self._workbench.place(placement)

    def move_to_mm(self, position: float) -> None:
        """The stage stands at ``position`` by its own count, wherever that is."""
        self._workbench.position = position

    def expose(self, patterns: np.ndarray, exposure_us: float, serial: int, began: int, lamp: float) -> np.ndarray:
        """Frames (N, rows, cols), one per pattern; see ``TwinRig.expose``. An empty table is dark."""
        if self._workbench.mounted is None:
            lamp = 0.0
        return self._rig.expose(patterns, exposure_us, serial, began, lamp)
