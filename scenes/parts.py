"""What a specimen consists of: triangle meshes with a material each.

A specimen has its own frame: z up towards the microscope, lengths in mm, z = 0 in the middle of the measuring range
unless its module says otherwise. Triangles run counter-clockwise seen from outside.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from .materials import MATERIALS


@dataclass(frozen=True, eq=False)
class Part:
    """A triangle mesh of one material.

    Parameters
    ----------
    vertices : (n, 3) float64
        Positions in mm.
    faces : (m, 3) int32
        Vertex indices, counter-clockwise seen from outside.
    normals : (n, 3) float64 or None
        Unit normals at the vertices, for smooth shading; None where each facet is flat.
    material : str
        A name in :data:`greenough.scenes.materials.MATERIALS`.
    """

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray | None
    material: str

    def __post_init__(self) -> None:
        if self.vertices.ndim != 2 or self.vertices.shape[1] != 3:
            raise ValueError(f"vertices must be (n, 3), not {self.vertices.shape}")
        if self.faces.ndim != 2 or self.faces.shape[1] != 3:
            raise ValueError(f"faces must be (m, 3), not {self.faces.shape}")
        if self.normals is not None and self.normals.shape != self.vertices.shape:
            raise ValueError(f"normals must be {self.vertices.shape}, not {self.normals.shape}")
        if self.material not in MATERIALS:
            raise ValueError(f"unknown material {self.material!r}")


@dataclass(frozen=True, eq=False)
class Specimen:
    """What lies under the microscope.

    Parameters
    ----------
    name : str
        As the catalogue knows it.
    parts : tuple of Part
        Its surfaces, in the specimen's frame.
    nominal : mapping of str to float
        The drawing's dimensions, the unit in each name.
    as_built : mapping of str to ndarray
        How this one really is, in the specimen's frame, the unit in each name: only truth may read it.
    """

    name: str
    parts: tuple[Part, ...]
    nominal: Mapping[str, float] = field(default_factory=dict)
    as_built: Mapping[str, np.ndarray] = field(default_factory=dict)


def transform(part: Part, to_from_part: np.ndarray) -> Part:
    """``part`` moved by the rigid motion ``to_from_part``, (4, 4)."""
    rotation, shift = to_from_part[:3, :3], to_from_part[:3, 3]
    normals = None if part.normals is None else part.normals @ rotation.T
    return Part(part.vertices @ rotation.T + shift, part.faces, normals, part.material)


def merge(parts: Sequence[Part]) -> tuple[np.ndarray, np.ndarray]:
    """Geometry of several parts as one mesh: vertices (n, 3) float64 and faces (m, 3) int32. Nothing is welded."""
    offsets = np.cumsum([0] + [len(part.vertices) for part in parts[:-1]])
    vertices = np.concatenate([part.vertices for part in parts])
    faces = np.concatenate([part.faces + offset for part, offset in zip(parts, offsets, strict=True)])
    return vertices, faces.astype(np.int32)
