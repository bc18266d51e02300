"""Clouds as other programs read them. Which format is told by the file's name.

======================  ================================================================================
``.ply``                points with all that is known of each, mm
``.xyz``, ``.asc``      lines of x, y and z in mm, with a resolution of a nanometre
``.npz``                NumPy arrays ``xyz``, ``pixels``, ``sigma_noise``, ``sigma_calibration``, and ``units``
``.stl``, ``.obj``      triangles between neighbouring pixels, mm
======================  ================================================================================
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import trimesh

from greenough.instrument.errors import InputError
from greenough.instrument.files import atomic_path

from .point_cloud import PointCloud, write_cloud
from .surface_mesh import surface_mesh


def export_cloud(cloud: PointCloud, path: str | Path) -> None:
    """Write a cloud; the file appears whole or not at all.

    Raises
    ------
    InputError
        When no format has the name's ending, or the cloud cannot be a surface.
    """
    path = Path(path)
    writer = WRITERS.get(path.suffix.lower())
    if writer is None:
        raise InputError(f"{path}: the name must end in one of {', '.join(WRITERS)}")
    writer(cloud, path)


def _write_lines(cloud: PointCloud, path: Path) -> None:
    with atomic_path(path) as temporary:
        np.savetxt(temporary, cloud.xyz, fmt="%.6f")


def _write_npz(cloud: PointCloud, path: Path) -> None:
    arrays = {
        "xyz": cloud.xyz,
        "pixels": cloud.pixels,
        "sigma_noise": cloud.noise_mm,
        "sigma_calibration": cloud.calibration_mm,
    }
    known = {name: values for name, values in arrays.items() if values is not None}
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        np.savez_compressed(file, allow_pickle=False, units=np.array("mm"), **known)


def _write_surface(cloud: PointCloud, path: Path) -> None:
    mesh = surface_mesh(cloud)
    kind = path.suffix.lower().removeprefix(".")
    written = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    written.remove_unreferenced_vertices()
    with atomic_path(path) as temporary:
        written.export(temporary, file_type=kind)


WRITERS: dict[str, Callable[[PointCloud, Path], None]] = {
    ".ply": lambda cloud, path: write_cloud(path, cloud),
    ".xyz": _write_lines,
    ".asc": _write_lines,
    ".npz": _write_npz,
    ".stl": _write_surface,
    ".obj": _write_surface,
}
"""What writes each format, by the ending of the name."""
