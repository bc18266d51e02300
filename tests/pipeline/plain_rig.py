"""A small rig of plain geometry: pinholes, a printed board, a stage, noise per exposure."""

import zlib
from dataclasses import dataclass, replace
from functools import lru_cache
from types import SimpleNamespace

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import expit

from greenough.instrument.contract import (
    CameraNoise,
    Frames,
    KnownUncertainty,
    Placement,
    Procedure,
    RigIdentity,
    SpotBoard,
)

SHAPE = (360, 480)
BOARD = SpotBoard(5, 7, 1.2, 0.8, 0.5, 8.0, ((2, 3), (2, 4), (1, 3)))
PROCEDURE = Procedure(
    (608.0, 152.0, 40.0, 12.0), (4, 4, 4, 12), postures=8, planes=10, plane_step_mm=0.3, exposure_share=0.8
)
UNCERTAINTY = KnownUncertainty(board_scale=3e-5, table_drift_mm=5e-4, path_drift_mm=5e-5)
TABLE_FROM_FLAT = np.array([[0.9986, -0.0523, 0, 0.1], [0.0523, 0.9986, 0, -0.05], [0, 0, 1, 0], [0, 0, 0, 1]])


@dataclass(frozen=True)
class Geometry:
    """Both lenses look down at the table's origin from ``distance``, leaning by ``lean_deg`` to either side.

    The projector's columns span ``field`` there; board, its shifts and the stage's way are ``scale`` times as large as
    they stand here.
    """

    focal_px: float
    distance: float
    lean_deg: float
    field: float
    scale: float


STEREOMICROSCOPE = Geometry(8506.0, 224.56, 6.0, 10.84, 1.0)
TABLETOP = Geometry(800.0, 400.0, 11.0, 280.0, 20.0)
"""A field of 24 cm, over which the sensitivity to heights varies by tens of per cent."""


def scaled(board: SpotBoard, scale: float) -> SpotBoard:
    lengths = ("pitch_mm", "big_diameter_mm", "small_diameter_mm", "size_mm")
    return replace(board, **{name: scale * getattr(board, name) for name in lengths})


class Killed(BaseException):
    """Stands for Ctrl-C or a kill at a bad moment."""


class PlainRig:
    """A profilometer of two pinholes 12° apart over a table that the stage lifts.

    ``dies_at`` is the capture of a whole fringe sequence during which the process is killed; ``hidden`` are postures
    whose board lies outside the picture; ``stage_error`` gives the table's true height for a reading.
    """

    def __init__(
        self,
        run="run",
        exposures_done=0,
        seed=1,
        dies_at=None,
        hidden=(),
        procedure=PROCEDURE,
        limit=1.6,
        stage_error=lambda reading: reading,
        geometry=STEREOMICROSCOPE,
        board=BOARD,
    ):
        self.identity = RigIdentity("plain", "camera 1", "projector 1", f"{seed:064x}")
        self.procedure, self.uncertainty = procedure, UNCERTAINTY
        self.geometry, self.board = geometry, scaled(board, geometry.scale)
        self.devices = ()
        self.camera = SimpleNamespace(
            shape=SHAPE,
            full_scale_dn=255.0,
            black_level_dn=4.0,
            noise=CameraNoise(6500.0, 10.0, 25.9),
            exposure_limits_us=(100.0, 1e6),
            exposure_us=8000.0,
        )
        self.projector = SimpleNamespace(shape=(2, 608))
        self.stage = SimpleNamespace(limits_mm=(-limit, limit), position_mm=0.0, move_to_mm=self._move)
        self.operator = SimpleNamespace(place=self._place)
        self.placed: list[Placement] = []
        self.moves: list[float] = []
        self._run, self._serial, self._seed, self._dies_at, self._hidden = run, exposures_done, seed, dies_at, hidden
        self.sequences, self._true_height = 0, stage_error

    def __enter__(self):
        return self

    def __exit__(self, *exc):
        return None

    def _move(self, position):
        self.moves.append(position)
        self.stage.position_mm = position

    def _place(self, placement):
        self.placed.append(placement)

    def capture(self, patterns):
        if len(patterns) > 1:
            self.sequences += 1
            if self.sequences == self._dies_at:
                raise Killed
        serials = self._serial + np.arange(len(patterns))
        self._serial += len(patterns)
        z, placement = self._true_height(self.stage.position_mm), self.placed[-1]
        exposure_us, hidden = self.camera.exposure_us, placement.posture in self._hidden
        lines = np.ascontiguousarray(patterns[:, 0]).tobytes()
        scenery = placement, hidden, z, self.geometry, self.board
        stack = photograph(scenery, lines, exposure_us, self._seed, self._run, int(serials[0]))
        return Frames(stack, 255.0, 4.0, exposure_us, 0.0, self.stage.position_mm, serials, serials * 0.01, self._run)


@lru_cache(maxsize=64)
def photograph(scenery, lines, exposure_us, seed, run, first_serial):
    """Frames (frames, rows, cols) uint8: the same for the same scene, run and exposure numbers, and kept for reuse."""
    light, column = scene(*scenery)
    grey = np.frombuffer(lines, dtype=np.uint8).reshape(-1, 608).astype(float)
    left = np.clip(column.astype(int), 0, 606)
    share = np.clip(column - left, 0, 1)
    stack = np.empty((len(grey), *SHAPE), dtype=np.uint8)
    for n, (frame, line) in enumerate(zip(stack, grey, strict=True)):
        shown = line[left] * (1 - share) + line[left + 1] * share
        electrons = 25.9 * shown * light * exposure_us / 8000 * 0.4
        rng = np.random.default_rng([seed, zlib.crc32(run.encode()), first_serial + n])
        noisy = electrons + np.sqrt(electrons + 100.0) * rng.standard_normal(SHAPE)
        frame[:] = np.clip(np.rint(noisy / 25.9 + 4), 0, 255)
    return stack


def scene(placement, hidden, z, geometry=STEREOMICROSCOPE, board=BOARD):
    """Reflected light and projector column of every pixel, (rows, cols) each."""
    table_from_part = pose_of(placement, hidden, geometry)
    table_from_part[2, 3] += z
    origin, direction = rays(geometry)
    normal, middle = table_from_part[:3, 2], table_from_part[:3, 3]
    point = origin + direction * ((middle - origin) @ normal / (direction @ normal))[..., None]
    reflectance = np.full(SHAPE, 0.85)
    if placement.part == "board" and placement.face == "printed":
        on_board = (point - middle) @ table_from_part[:3, :2]
        inside = np.full(SHAPE, -1.0)
        for centre, diameter in zip(board.centres(), board.diameters(), strict=True):
            offset = on_board - centre
            np.maximum(inside, diameter / 2 - np.hypot(offset[..., 0], offset[..., 1]), out=inside)
        edge = geometry.distance / geometry.focal_px  # a pixel wide
        white = expit((-4 if board.dark_spots else 4) * inside / edge)
        reflectance = 0.08 + 0.77 * white
    column = projector_column(point, geometry)
    lit = (column > 0) & (column < 607) & (np.abs(point[..., 1]) < 0.332 * geometry.field)
    return reflectance * lit, column


def rays(geometry=STEREOMICROSCOPE):
    """Camera centre (3,) and directions (rows, cols, 3) in the table's frame; the camera leans towards +x."""
    sine, cosine = np.sin(np.radians(geometry.lean_deg)), np.cos(np.radians(geometry.lean_deg))
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]]
    x, y = (u - 241.3) / geometry.focal_px, (v - 178.2) / geometry.focal_px
    return geometry.distance * np.array([sine, 0, cosine]), np.stack(
        [x * cosine - sine, -y, -x * sine - cosine], axis=-1
    )


def projector_column(point, geometry=STEREOMICROSCOPE):
    sine, cosine = np.sin(np.radians(geometry.lean_deg)), np.cos(np.radians(geometry.lean_deg))
    ray = point + geometry.distance * np.array([sine, 0, -cosine])
    return 303.5 + 608 / geometry.field * geometry.distance * (ray @ [cosine, 0, sine]) / -(ray @ [-sine, 0, cosine])


def pose_of(placement, hidden=False, geometry=STEREOMICROSCOPE):
    """table_from_part (4, 4): where a person lays it."""
    pose = TABLE_FROM_FLAT.copy()
    if placement.part == "tilted plane":
        pose[:3, :3] = Rotation.from_euler("xy", [1.5, -2.0], degrees=True).as_matrix()
        pose[2, 3] = 0.4
    if placement.posture is not None:
        k = placement.posture
        axis = np.array([np.cos(2.4 * k), np.sin(2.4 * k), 0])
        pose[:3, :3] = (
            Rotation.from_rotvec(np.radians(9 + k) * axis) * Rotation.from_euler("z", 40 * k, degrees=True)
        ).as_matrix()
        pose[:2, 3] = [0.3 * np.cos(k), 0.2 * np.sin(k)]
    if hidden:
        pose[0, 3] += 50.0
    pose[:3, 3] *= geometry.scale
    return pose
