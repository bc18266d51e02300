"""What really lies under the microscope: parts, their motions, and the scene that is rendered."""

from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from greenough.instrument.contract import Placement
from greenough.instrument.errors import InputError
from greenough.instrument.rigfile import RigFile
from greenough.scenes.board import BoardErrors, PrintedBoard, blank_height, board, print_board
from greenough.scenes.catalogue import FLAT, NAMES, specimen
from greenough.scenes.mesh_file import USUAL_MATERIAL, load_mesh
from greenough.scenes.parts import Part, Specimen, transform

from .placing import flat, lifted, on_wedge, posed, tilted
from .randomness import instrument_rng
from .settings import TwinSettings
from .stage import StageErrors, build_stage, rigid

BOARDS = ("board", "second-board")


@dataclass(frozen=True, eq=False)
class Mounted:
    """A specimen on the table: whether it has relief decides how it must be sampled."""

    placement: Placement
    specimen: Specimen
    table_from_part: np.ndarray  # (4, 4)
    flat: bool  # no relief: it can neither light nor shade itself


class Workbench:
    """The mechanical half of one instrument as it was built: stage, boards, and what is mounted."""

    def __init__(self, rig_file: RigFile, settings: TwinSettings) -> None:
        self._rig_file = rig_file
        self._settings = settings
        self.stage: StageErrors = build_stage(settings.stage, settings.seed)
        self.position = 0.0
        self.drift = np.zeros(3)  # of the table against the microscope, twin's frame
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
        known = s.scale_error_ppm if part == "board" else 0.0
        errors = BoardErrors(s.print_sd_um, s.scale_sd_ppm, s.bow_sd_um, s.wedge_sd_urad, s.ink_thickness_um, known)
        return print_board(self._rig_file.board.nominal, errors, instrument_rng(self._settings.seed, part))

    def place(self, placement: Placement) -> None:
        """Mount a part.

        Raises InputError for one that neither the rig knows nor is a mesh file, a bad pose, a material that is not
        known, or one for what is no mesh file.
        """
        self.mounted = self._mount(placement)

    def _mount(self, placement: Placement) -> Mounted:
        seed = self._settings.seed
        if Path(placement.part).suffix:
            material = USUAL_MATERIAL if placement.material is None else placement.material
            part = load_mesh(placement.part, placement.unit, placement.pose_mm_deg, material)
            return Mounted(placement, part, np.eye(4), flat=False)
        if placement.material is not None:
            raise InputError(
                f"the {placement.part} has materials of its own; leave {placement.material!r} out, which is for mesh "
                "files"
            )
        if placement.part in BOARDS:
            if any(placement.pose_mm_deg):
                raise InputError(
                    f"the {placement.part} is held in numbered postures; leave out its pose {placement.pose_mm_deg}"
                )
            printed = self.printed_board(placement.part)
            if placement.posture is not None:
                pose = tilted(seed, placement.posture, printed.centres)
            elif placement.face == "printed":
                pose = self.table_from_flat_board(placement.part)
            else:
                pose = self.table_from_turned_board(placement.part)
            return Mounted(placement, _face(printed, placement.face), pose, flat=True)
        if placement.part not in NAMES:
            known = ", ".join((*BOARDS, *NAMES))
            raise InputError(
                f"unknown sample {placement.part!r}; choose one of {known}, or give the path of a mesh file"
            )
        part = specimen(placement.part, seed)
        table_from_part = flat(seed, placement.part) @ posed(placement.pose_mm_deg)
        return Mounted(placement, part, table_from_part, flat=placement.part in FLAT)

    def table_from_flat_board(self, part: str = "board") -> np.ndarray:
        """Motion (4, 4) of the board that lies on its blank face."""
        return flat(self._settings.seed, part) @ on_wedge(self.printed_board(part).wedge)

    def table_from_turned_board(self, part: str = "board") -> np.ndarray:
        """Motion (4, 4) of the board that lies on its printed face: the ink lifts its blank one."""
        lift = lifted(self.printed_board(part).ink_thickness)
        return flat(self._settings.seed, f"{part} blank") @ lift

    def blank_face_height(self, reading: float, xy_world: np.ndarray) -> np.ndarray:
        """True height (n,) of the blank face at ``xy_world`` (n, 2), calibrated frame, where the stage reads so."""
        motion = self.world_from_twin() @ self.stage.twin_from_table(reading) @ self.table_from_turned_board()
        inverse = np.linalg.inv(motion)
        # The face is flat to micrometres: the height used to find the place on it hardly matters.
        points = np.column_stack([xy_world, np.full(len(xy_world), reading)])
        on_board = points @ inverse[:3, :3].T + inverse[:3, 3]
        on_board[:, 2] = blank_height(self.printed_board("board"), on_board[:, :2])
        return on_board @ motion[2, :3] + motion[2, 3]

    def twin_from_part(self) -> np.ndarray:
        """Where the mounted part is, (4, 4), at the stage's present position, as long as the table has not drifted."""
        assert self.mounted is not None
        return self.stage.twin_from_table(self.position) @ self.mounted.table_from_part

    def parts_in_twin(self) -> list[Part]:
        """The mounted surfaces in the twin's frame, as ``twin_from_part``."""
        assert self.mounted is not None
        return [transform(part, self.twin_from_part()) for part in self.mounted.specimen.parts]

    def drifted_twin_from_part(self) -> np.ndarray:
        """Where the mounted part really is, (4, 4)."""
        return rigid(Rotation.identity(), self.drift) @ self.twin_from_part()

    def world_from_twin(self) -> np.ndarray:
        """The calibrated frame as it really is, (4, 4): that of the board lying flat, printed face up, at z = 0."""
        return np.linalg.inv(self.stage.twin_from_table(0.0) @ self.table_from_flat_board())


@lru_cache(maxsize=4)
def _face(printed: PrintedBoard, face: Literal["printed", "blank"]) -> Specimen:
    """One face of a board, built once for all its postures."""
    return board(printed, face)
