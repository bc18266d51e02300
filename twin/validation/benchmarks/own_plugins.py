"""A rig without lenses by nothing but Mitsuba's own plugins: what they take to render the same pictures.

Their projector shows one picture at a time and knows no lens: frames are rendered one by one, of a rig in the pinhole
limit. It is given our projector's band-limited pattern, so that both show the same function of the place on the mirrors
and neither has to sample the mirrors' staircase.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...dmd import Mirrors, band_limited
from ...renderer import mi
from ...settings import OpticsSettings, TwinSettings

PINHOLES = ("twin.optics.glass=false", "twin.optics.finite_aperture=false", "twin.optics.camera_diffraction=false")
"""Settings of a rig in the limit that both renderers know."""


@dataclass(frozen=True, eq=False)
class OwnPlugins:
    """A scene of perspective camera, projector and path integrator, and the pictures that it can be given to show."""

    scene: mi.Scene
    pictures: tuple[mi.TensorXf, ...]  # of the projector, (texel rows, texel columns, 1) each

    def render(self, samples: int, frames: Sequence[int], seed: int = 0) -> list[mi.TensorXf]:
        """Radiance of ``frames``, (rows, cols, 1) each, evaluated, all from the same ``samples`` paths per pixel."""
        params = mi.traverse(self.scene)
        rendered = []
        for frame in frames:
            params["projector.irradiance.data"] = self.pictures[frame]
            params.update()
            rendered.append(mi.TensorXf(mi.render(self.scene, spp=samples, seed=mi.UInt32(seed))))
            np.array(rendered[-1])  # waits, as one who saves a frame does
        return rendered


def own_plugins(scene: dict[str, Any], settings: TwinSettings, patterns: np.ndarray) -> OwnPlugins:
    """The twin's ``scene``, a dictionary of ``greenough.twin.scene_dict``, with Mitsuba's own plugins in place of ours.

    Meshes, materials, film and poses are the same, and so is the number of bounces. Parameters of a rig that is not in
    the pinhole limit would not be kept.
    """
    pictures = projector_pictures(patterns, settings.optics)
    sensor, projector = scene["sensor"], scene["projector"]
    cols, distance = sensor["film"]["width"], projector["focus_distance"]
    width = pictures.shape[2] * texel_mm(settings.optics)
    replaced = {
        "integrator": {"type": "path", "max_depth": scene["integrator"]["bounces"] + 1, "rr_depth": 100},
        "sensor": {
            "type": "perspective",
            "to_world": sensor["to_world"],
            "film": sensor["film"],
            "fov": float(np.degrees(2 * np.arctan(cols / 2 / sensor["focal_length_px"]))),
            "fov_axis": "x",
            "near_clip": 1.0,
            "far_clip": 1e4,
        },
        "projector": {
            "type": "projector",
            "to_world": projector["to_world"],
            "fov": float(np.degrees(2 * np.arctan(width / 2 / distance))),
            "fov_axis": "x",
            "scale": distance**2 / np.pi,  # from the irradiance at distance 1, times pi, to that in our focused plane
            "irradiance": {
                "type": "bitmap",
                "data": mi.TensorXf(pictures[0][..., None]),
                "raw": True,
                "format": "variant",
                "accel": False,  # a GPU's own interpolation is to 1/256 of a texel
                "wrap_mode": "clamp",
            },
        },
    }
    tensors = tuple(mi.TensorXf(picture[..., None]) for picture in pictures)
    return OwnPlugins(mi.load_dict(scene | replaced), tensors)


def texel_mm(optics: OpticsSettings) -> float:
    """Side of the square texels of ``projector_pictures`` at the specimen: that of a cell of our own tables."""
    return optics.column_pitch_um * 1e-3 / _table(np.zeros((1, 2, 2), np.uint8), optics).cells[0]


def projector_pictures(patterns: np.ndarray, optics: OpticsSettings) -> np.ndarray:
    """What the mirrors show after the projector's diffraction, (N, texel rows, texel columns) float32.

    For ``patterns``, (N, rows, cols) uint8, that do not vary along the rows. The middle texel lies on the axis.
    """
    table = _table(patterns, optics)
    texel = texel_mm(optics)
    middle = (patterns.shape[2] - 1) / 2 + 0.25, (patterns.shape[1] - 1) / 2
    pitch = optics.column_pitch_um * 1e-3, optics.row_pitch_um * 1e-3
    counts = table.values.shape[1], len(table.row_profile)
    # Columns and rows of the table's cells, and of as many texels to either side of the axis as reach beyond them.
    cells = [table.origin[a] + np.arange(counts[a]) / table.cells[a] for a in (0, 1)]
    reach = [int(np.ceil((cells[a][-1] - cells[a][0]) / 2 * pitch[a] / texel)) + 1 for a in (0, 1)]
    x, y = (middle[a] + np.arange(-reach[a], reach[a] + 1) * texel / pitch[a] for a in (0, 1))
    profile = np.interp(y, cells[1], table.row_profile, left=0.0, right=0.0)
    lines = [np.interp(x, cells[0], line, left=0.0, right=0.0) for line in table.values[0].T]
    return np.stack([np.outer(profile, line) for line in lines]).astype(np.float32)


def _table(patterns: np.ndarray, optics: OpticsSettings) -> Any:
    mirrors = Mirrors(
        optics.column_pitch_um * 1e-3, optics.row_pitch_um * 1e-3, optics.mirror_fill, optics.off_state, optics.gamma
    )
    return band_limited(patterns, mirrors, optics.na, optics.wavelength_um * 1e-3)
