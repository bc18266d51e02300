"""The truth about what is mounted now: what only a twin can say, and what no pipeline is told."""

from dataclasses import dataclass

import numpy as np

from greenough.instrument.rigfile import RigFile
from greenough.scenes.parts import Part, Specimen, transform

from .renderer import dr, mi
from .scene import camera_dict, projector_dict, specimen_dict
from .settings import TwinSettings
from .workbench import Workbench

MIN_COSINE = 0.2  # of the surface's normal to either path, for a pixel to count as lit and seen


@dataclass(frozen=True, eq=False)
class Truth:
    """What each pixel's central ray really meets.

    Parameters
    ----------
    xyz : (rows, cols, 3) float64
        Point in the twin's frame; NaN where the ray meets nothing.
    normal : (rows, cols, 3) float64
        Geometric unit normal there.
    column, row : (rows, cols) float64
        Where the point lies on the mirror array through the middle of the projector's pupil, in mirrors; NaN as above.
    lit_and_seen : (rows, cols) bool
        The middle of both pupils is visible from the point, column and row lie on the array, and the normal's cosine to
        both paths exceeds 0.2.
    world_from_twin : (4, 4)
        The calibrated frame, computed from the board's flat posture as it really was.
    """

    xyz: np.ndarray
    normal: np.ndarray
    column: np.ndarray
    row: np.ndarray
    lit_and_seen: np.ndarray
    world_from_twin: np.ndarray

    def _repr_html_(self) -> str:
        from greenough.instrument.notebook import card, map_picture, share, span

        z = self.xyz_world[..., 2]
        facts = {
            "rows x columns": " x ".join(str(size) for size in z.shape),
            "pixels lit and seen": share(int(self.lit_and_seen.sum()), self.lit_and_seen.size),
            "z in the calibrated frame, mm": span(z),
        }
        return card("Truth", facts, [map_picture(np.where(self.lit_and_seen, z, np.nan), "true z, mm")])

    @property
    def xyz_world(self) -> np.ndarray:
        """``xyz`` in the calibrated frame, (rows, cols, 3)."""
        return self.xyz @ self.world_from_twin[:3, :3].T + self.world_from_twin[:3, 3]

    @property
    def normal_world(self) -> np.ndarray:
        """``normal`` in the calibrated frame, (rows, cols, 3)."""
        return self.normal @ self.world_from_twin[:3, :3].T


class Bench:
    """Speaks of the twin that it was opened with, in that twin's present state."""

    def __init__(self, rig_file: RigFile, settings: TwinSettings, workbench: Workbench) -> None:
        self._rig_file = rig_file
        self._workbench = workbench
        self.settings = settings

    @property
    def world_from_twin(self) -> np.ndarray:
        """The calibrated frame, (4, 4)."""
        return self._workbench.world_from_twin()

    @property
    def specimen(self) -> Specimen:
        """What is mounted, in its own frame, with its dimensions as built."""
        assert self._workbench.mounted is not None
        return self._workbench.mounted.specimen

    @property
    def world_from_part(self) -> np.ndarray:
        """Where the mounted part really is, (4, 4)."""
        return self.world_from_twin @ self._workbench.drifted_twin_from_part()

    @property
    def printed_centres(self) -> np.ndarray:
        """The calibration board's spots as they were printed, (spots, 2) mm in the board's frame."""
        return self._workbench.printed_board("board").centres

    def blank_face_height(self, reading: float, xy_world: np.ndarray) -> np.ndarray:
        """Where the board's blank face truly is during calibration: heights (n,) at ``xy_world`` (n, 2), mm."""
        return self._workbench.blank_face_height(reading, xy_world)

    def parts_in_world(self) -> list[Part]:
        """The mounted surfaces in the calibrated frame: the mesh to compare with."""
        motion = self.world_from_part
        return [transform(part, motion) for part in self.specimen.parts]

    def truth(self) -> Truth:
        """Trace the central ray of every pixel."""
        rows, cols = self._rig_file.camera.shape
        mirror_rows, mirror_cols = self._rig_file.projector.shape
        blank = np.zeros((1, mirror_rows, mirror_cols), np.uint8)
        scene = mi.load_dict(
            {
                "type": "scene",
                "embree_use_robust_intersections": True,
                "sensor": camera_dict(self.settings, (rows, cols)),
                "projector": projector_dict(self.settings, blank),
            }
            | specimen_dict(
                [transform(part, self._workbench.drifted_twin_from_part()) for part in self.specimen.parts],
                self.settings.render,
            )
        )
        sensor, projector = scene.sensors()[0], scene.emitters()[0]
        pixel = dr.arange(mi.UInt32, rows * cols)
        film = mi.Point2f((mi.Float(pixel % cols) + 0.5) / cols, (mi.Float(pixel // cols) + 0.5) / rows)
        middle = mi.Point2f(0.5, 0.5)
        ray, _ = sensor.sample_ray(0.0, 0.5, film, middle)
        si = scene.ray_intersect(ray)
        pupil, column, row, _ = projector.aim(si.p, middle)
        to_projector = dr.normalize(mi.Vector3f(pupil - si.p))
        shadowed = scene.ray_test(si.spawn_ray_to(pupil))
        facing = (-dr.dot(si.n, ray.d) > MIN_COSINE) & (dr.dot(si.n, to_projector) > MIN_COSINE)
        inside = (column >= 0) & (column <= mirror_cols - 0.5) & (row >= 0) & (row <= mirror_rows - 1)
        hit = np.array(si.is_valid()).reshape(rows, cols)

        def image(values: mi.Float) -> np.ndarray:
            return np.where(hit, np.array(values, np.float64).reshape(rows, cols), np.nan)

        return Truth(
            xyz=np.stack([image(v) for v in (si.p.x, si.p.y, si.p.z)], axis=-1),
            normal=np.stack([image(v) for v in (si.n.x, si.n.y, si.n.z)], axis=-1),
            column=image(column),
            row=image(row),
            lit_and_seen=np.array(si.is_valid() & ~shadowed & facing & inside).reshape(rows, cols),
            world_from_twin=self.world_from_twin,
        )
