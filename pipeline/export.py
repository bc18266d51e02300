"""Clouds and cameras as other programs read them. Which format is told by the file's name.

==============================  ==================================================================================
``.ply``                        points with all that is known of each, mm: normals, intensity in DN, uncertainties
``.xyz``, ``.asc``              lines of x, y and z in mm, with a resolution of a nanometre
``.npz``                        NumPy arrays ``xyz``, ``pixels``, ``sigma_noise``, ``sigma_calibration``,
                                ``intensity`` and ``normals``, as far as known, and ``units``
``.stl``, ``.obj``              triangles between neighbouring pixels, mm
``.x3p``, ``.gwy``, ``.gsf``    a regular height map (`height_map`) with its voids, m (`height_map_files`)
``.yaml``, ``.json``, ``.xml``  a calibration's camera, for OpenCV (`camera_file`)
==============================  ==================================================================================
"""

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import trimesh

from greenough.instrument.errors import InputError
from greenough.instrument.files import atomic_path

from .height_map import HeightMap, height_map
from .height_map_files import write_gsf, write_gwy, write_x3p
from .point_cloud import PointCloud, write_cloud
from .surface_mesh import surface_mesh, surface_normals

CAMERA_ENDINGS = (".yaml", ".yml", ".json", ".xml")
"""Endings of files that a calibration is exported to, and no cloud."""


def export_cloud(cloud: PointCloud, path: str | Path, pitch_mm: float | None = None) -> Mapping[str, object]:
    """Write a cloud; the file appears whole or not at all.

    Parameters
    ----------
    cloud : PointCloud
    path : path
    pitch_mm : float, optional
        Of a height map: see `height_map`.

    Returns
    -------
    mapping
        What was written, by name with the unit in the name.

    Raises
    ------
    InputError
        When no format has the name's ending, a pitch is given for what is no height map, or the cloud cannot be what
        is asked for.
    """
    path = Path(path)
    ending = path.suffix.lower()
    if ending in MAP_WRITERS:
        heights = height_map(cloud, pitch_mm)
        MAP_WRITERS[ending](heights, path)
        rows, cols = heights.z.shape
        voids = int(heights.voids.sum())
        return {"unit": "m", "rows": rows, "cols": cols, "pitch_um": 1e3 * heights.pitch, "voids": voids}
    if ending not in WRITERS:
        known = ", ".join((*WRITERS, *MAP_WRITERS))
        raise InputError(f"{path}: the name must end in one of {known} for points")
    if pitch_mm is not None:
        raise InputError(
            f"{path} is no height map and has no pitch: leave --pitch-um out, or name a file that ends in "
            f"{', '.join(MAP_WRITERS)}"
        )
    WRITERS[ending](cloud, path)
    return {"unit": "mm"}


def _write_points(cloud: PointCloud, path: Path) -> None:
    if cloud.normals is None:
        with suppress(InputError):  # points that are no surface have no normals
            cloud = replace(cloud, normals=surface_normals(cloud))
    write_cloud(path, cloud)


def _write_lines(cloud: PointCloud, path: Path) -> None:
    with atomic_path(path) as temporary:
        np.savetxt(temporary, cloud.xyz, fmt="%.6f")


def _write_npz(cloud: PointCloud, path: Path) -> None:
    arrays = {
        "xyz": cloud.xyz,
        "pixels": cloud.pixels,
        "sigma_noise": cloud.noise_mm,
        "sigma_calibration": cloud.calibration_mm,
        "intensity": cloud.intensity,
        "normals": cloud.normals,
    }
    known = {name: values for name, values in arrays.items() if values is not None}
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        np.savez_compressed(file, allow_pickle=False, units=np.array("mm"), **known)


def _write_surface(cloud: PointCloud, path: Path) -> None:
    mesh = surface_mesh(cloud)
    kind = path.suffix.lower().removeprefix(".")
    written = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    written.remove_unreferenced_vertices()
    content = written.export(file_type=kind)
    with atomic_path(path) as temporary:
        temporary.write_bytes(content if isinstance(content, bytes) else str(content).encode())


WRITERS: dict[str, Callable[[PointCloud, Path], None]] = {
    ".ply": _write_points,
    ".xyz": _write_lines,
    ".asc": _write_lines,
    ".npz": _write_npz,
    ".stl": _write_surface,
    ".obj": _write_surface,
}
"""What writes points in each format, by the ending of the name."""

MAP_WRITERS: dict[str, Callable[[HeightMap, Path], None]] = {".x3p": write_x3p, ".gwy": write_gwy, ".gsf": write_gsf}
"""The same for height maps."""
