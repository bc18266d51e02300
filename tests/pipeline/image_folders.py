"""What a rig shows, kept as somebody else keeps it: images in folders, with names and an order of their own."""

from collections.abc import Sequence
from pathlib import Path

import cv2

from greenough.instrument.contract import BLANK, Placement, Rig
from greenough.pipeline.sequence import sequence_patterns

RIG = """\
name = "theirs"
driver = "images"

[camera]
rows = {rows}
cols = {cols}
black_level_dn = {black}

[projector]
rows = {mirror_rows}
cols = {mirror_cols}

[board]
rows = {board.rows}
cols = {board.cols}
pitch_mm = {board.pitch_mm}
big_diameter_mm = {board.big_diameter_mm}
small_diameter_mm = {board.small_diameter_mm}
size_mm = {board.size_mm}
big = {big}

[procedure]
periods_px = {periods}
steps = {steps}

[uncertainty]
board_scale_ppm = 30.0
table_drift_um = 0.5
path_drift_um = 0.05

[images]
postures = "board/pose_{{}}"
planes = "planes/z{{}}"
plane_step_mm = 0.001
"""


def rig_file(rig: Rig) -> str:
    """A rig file for the images that `keep` writes."""
    board, procedure = rig.board, rig.procedure
    return RIG.format(
        rows=rig.camera.shape[0],
        cols=rig.camera.shape[1],
        black=rig.camera.black_level_dn,
        mirror_rows=max(4, rig.projector.shape[0]),
        mirror_cols=rig.projector.shape[1],
        board=board,
        big=[list(spot) for spot in board.big],
        periods=list(procedure.periods_px[::-1]),
        steps=list(procedure.steps[::-1]),
    )


def keep(rig: Rig, folder: Path, heights_mm: Sequence[float]) -> None:
    """Capture postures, the flat one last, then planes, and write them: finest fringes first, heights in µm."""
    postures = rig.procedure.postures
    for k in range(postures):
        rig.operator.place(Placement("board", posture=k) if k < postures - 1 else Placement("board"))
        rig.stage.move_to_mm(0.0)
        keep_as_it_lies(rig, folder / f"board/pose_{k + 1}")
    rig.operator.place(Placement("board", face=BLANK))
    for height in (0.0, *heights_mm):
        rig.stage.move_to_mm(float(height))
        keep_as_it_lies(rig, folder / f"planes/z{1000 * height:+.0f}")
    rig.stage.move_to_mm(0.0)


def keep_as_it_lies(rig: Rig, folder: Path) -> None:
    """One capture, under names that tell the period's number, the finest first, and the step; a Gray code's first."""
    procedure = rig.procedure
    frames = iter(rig.capture(sequence_patterns(procedure, rig.projector.shape)).stack)
    names = [
        f"shift{step + 1}_freq{len(procedure.steps) - number}.png"
        for number, count in enumerate(procedure.steps)
        for step in range(count)
    ]
    names += [f"bit{k + 1}.png" for k in range(procedure.gray_bits)]
    folder.mkdir(parents=True)
    for name, frame in zip(names, frames, strict=True):
        assert cv2.imwrite(str(folder / name), frame)
