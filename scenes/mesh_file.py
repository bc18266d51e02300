"""A mesh from anybody's STL, PLY or OBJ file, with its unit and where it is put."""

from pathlib import Path

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from greenough.instrument.errors import FileError, InputError
from greenough.instrument.file_errors import reading
from greenough.instrument.files import check_readable

from .materials import MATERIALS
from .parts import Part, Specimen

UNITS_MM = {"um": 1e-3, "mm": 1.0, "m": 1e3, "inch": 25.4}
HALF_VOLUME_MM = (6.5, 5.0, 1.6)  # what a specimen may fill to either side of the origin
MIN_SIZE_MM = 0.1  # about ten pixels: a smaller one was meant in another unit
SUFFIXES = (".stl", ".ply", ".obj")
USUAL_MATERIAL = "matte"


def load_mesh(
    path: str | Path,
    unit: str = "mm",
    pose_mm_deg: tuple[float, float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
    material: str = USUAL_MATERIAL,
) -> Specimen:
    """Read a mesh file as a specimen of one material.

    Parameters
    ----------
    path : str or Path
        An STL, PLY or OBJ file with triangles (larger polygons are split).
    unit : str
        Of the file: "um", "mm", "m" or "inch".
    pose_mm_deg : 6 floats
        Where it is put: the file's geometry is turned about its own x axis, then y, then z (degrees, fixed axes
        through its origin), then its origin is moved to (x, y, z) in mm.
    material : str
        A name in :data:`greenough.scenes.materials.MATERIALS`.

    Raises
    ------
    InputError
        If the file cannot be read, has no faces or a vertex that is not finite, the unit or the material is unknown,
        the pose is not six finite numbers, or the posed mesh reaches beyond ± 6.5 x 5.0 x 1.6 mm or is smaller than
        0.1 mm.
    """
    path = Path(path)
    if material not in MATERIALS:
        raise InputError(f"the material of {path} is {material!r}; choose one of {', '.join(MATERIALS)}")
    if unit not in UNITS_MM:
        raise InputError(f"unit of {path} is {unit!r}; choose one of {', '.join(UNITS_MM)}")
    pose = np.asarray(pose_mm_deg, float)
    if pose.shape != (6,) or not np.isfinite(pose).all():
        raise InputError(
            f"pose of {path} is {pose_mm_deg}; give six finite numbers: x, y, z in mm, then three angles in degrees"
        )
    raw, faces = _read(path)
    vertices = Rotation.from_euler("xyz", pose[3:], degrees=True).apply(raw * UNITS_MM[unit]) + pose[:3]
    used = vertices[np.unique(faces)]
    low, high = used.min(axis=0), used.max(axis=0)
    if (np.maximum(-low, high) > HALF_VOLUME_MM).any() or (high - low).max() < MIN_SIZE_MM:
        box = " x ".join(f"{size:.4g}" for size in high - low)
        middle = ", ".join(f"{value:.4g}" for value in (low + high) / 2)
        limit = " x ".join(f"±{half:g}" for half in HALF_VOLUME_MM)
        raise InputError(
            f"{path} read in {unit} measures {box} mm around ({middle}) mm, but must measure at "
            f"least {MIN_SIZE_MM:g} mm and stay inside {limit} mm; check its unit and pose"
        )
    return Specimen(path.stem, (Part(vertices, faces, None, material),))


def _read(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (n, 3) float64 and faces (m, 3) int32 as the file has them."""
    if path.suffix.lower() not in SUFFIXES:
        raise InputError(f"{path} is no mesh file that can be read; give one of {', '.join(SUFFIXES)}")
    check_readable(path, missing=f"mesh file {path} does not exist")
    try:
        with reading(path):
            if path.suffix.lower() == ".stl":
                _check_length(path.read_bytes())
            mesh = trimesh.load(path, force="mesh", process=False, skip_materials=True)
    except FileError:
        raise
    except Exception as error:  # trimesh's readers raise whatever they stumble over
        raise InputError(
            f"{path} cannot be read as {path.suffix[1:].upper()}: it is damaged or of another format"
        ) from error
    if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0:
        raise InputError(f"{path} has no faces; export it again, as a triangle mesh and not as a point cloud")
    faces, vertices = np.asarray(mesh.faces, np.int64), np.asarray(mesh.vertices, float)
    if faces.min() < 0 or faces.max() >= len(vertices):
        wrong = faces[(faces < 0) | (faces >= len(vertices))][0]
        raise InputError(
            f"{path} has a face with vertex {wrong}, but its vertices are 0 to {len(vertices) - 1}; export it again"
        )
    if not np.isfinite(vertices).all():
        bad = int(np.argmin(np.isfinite(vertices).all(axis=-1)))
        raise InputError(f"vertex {bad} of {path} is not finite; repair or export it again")
    return vertices, faces.astype(np.int32)


def _check_length(stl: bytes) -> None:
    """Raise ValueError for a binary STL that ends too early: readers take its rest for text without faces."""
    if len(stl) >= 84 and not stl.startswith(b"solid"):
        triangles = int.from_bytes(stl[80:84], "little")
        if len(stl) < 84 + 50 * triangles:
            raise ValueError(f"{triangles} triangles do not fit into {len(stl)} bytes")
