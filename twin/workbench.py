"""What really lies under the microscope: parts, their motions, and the scene that is rendered."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from greenough.instrument.contract import Placement
from greenough.instrument.errors import InputError
from greenough.instrument.rigfile import RigFile
from greenough.scenes.board import BoardErrors, PrintedBoard, board, print_board
from greenough.scenes.catalogue import NAMES, specimen
from greenough.scenes.mesh_file import load_mesh
from greenough.scenes.parts import Part, Specimen, transform

from .placing import flat, lifted, on_wedge, tilted
from .randomness import instrument_rng
from .settings import TwinSettings
from .stage import StageErrors, build_stage

BOARDS = ("board", "second-board")


@dataclass(frozen=True, eq=False)
class Mounted:
    """A specimen on the table: whether it is of one colour and without relief decides how it must be sampled."""

    placement: Placement
    specimen: Specimen
    table_from_part: np.ndarray  # (4, 4)
    plain: bool  # one material and no relief
    flat: bool  # no relief: it cannot light itself


class Workbench:
    """The mechanical half of one instrument as it was built: stage, boards, and what is mounted."""

    def __init__(self, rig_file: RigFile, settings: TwinSettings) -> None:
        self._rig_file = rig_file
        self._settings = settings
        self.stage: StageErrors = build_stage(settings.stage, settings.seed)
        self.position = 0.0
        self.mounted: Mounted | None = None

    def printed_board(self, part: str) -> PrintedBoard:
        """The calibration board or the second board as it was printed."""
        return {"board": self._board, "second-board": self._second_board}[part]

    @cached_property
    def _board(self) -> PrintedBoard:
        return self._print("board")

    @cached_property
    def _second_board(self) -> PrintedBoard:
        return self._print("second-board")

    def _print(self, part: str) -> PrintedBoard:
        s = self._settings.board
        errors = BoardErrors(s.print_sd_um, s.scale_sd_ppm, s.bow_sd_um, s.wedge_sd_urad, s.ink_thickness_um)
        return print_board(self._rig_file.board.nominal, errors, instrument_rng(self._settings.seed, part))

    def place(self, placement: Placement) -> None:
        """Mount a part. Raises InputError for a part that neither the rig knows nor is a mesh file."""
        self.mounted = self._mount(placement)

    def _mount(self, placement: Placement) -> Mounted:
        seed = self._settings.seed
        if placement.part in BOARDS:
            printed = self.printed_board(placement.part)
            if placement.posture is not None:
                pose = tilted(seed, placement.posture, printed.centres)
            elif placement.face == "printed":
                pose = self.table_from_flat_board(placement.part)
            else:  # lying on its ink lifts the blank face
                pose = flat(seed, f"{placement.part} blank") @ lifted(printed.ink_thickness)
            return Mounted(placement, board(printed, placement.face), pose, plain=placement.face == "blank", flat=True)
        if Path(placement.part).suffix:
            part = load_mesh(placement.part, placement.unit, placement.pose_mm_deg)
            return Mounted(placement, part, np.eye(4), plain=False, flat=False)
        if placement.part not in NAMES:
            known = ", ".join((*BOARDS, *NAMES))
            raise InputError(
                f"unknown sample {placement.part!r}; choose one of {known}, or give the path of a mesh file."
            )
        part = specimen(placement.part, seed)
        is_plane = placement.part == "plane"
        return Mounted(placement, part, flat(seed, placement.part), plain=is_plane, flat=is_plane)

    def table_from_flat_board(self, part: str = "board") -> np.ndarray:
        """Motion (4, 4) of the board that lies on its blank face."""
        return flat(self._settings.seed, part) @ on_wedge(self.printed_board(part).wedge)

    def twin_from_part(self) -> np.ndarray:
        """Where the mounted part really is, (4, 4), at the stage's present position."""
        assert self.mounted is not None
        return self.stage.twin_from_table(self.position) @ self.mounted.table_from_part

    def parts_in_twin(self) -> list[Part]:
        """The mounted surfaces in the twin's frame."""
        assert self.mounted is not None
        motion = self.twin_from_part()
        return [transform(part, motion) for part in self.mounted.specimen.parts]

    def world_from_twin(self) -> np.ndarray:
        """The calibrated frame as it really is, (4, 4): that of the board lying flat, printed face up, at z = 0."""
        return np.linalg.inv(self.stage.twin_from_table(0.0) @ self.table_from_flat_board())
