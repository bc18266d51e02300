"""Point clouds and meshes as files.

Clouds and meshes are written as binary little-endian PLY in mm, with facts in header lines
``comment greenough key=value``. Meshes are read from PLY, STL, OBJ and what else trimesh reads.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import trimesh

from greenough.instrument.errors import FileError, InputError
from greenough.instrument.file_errors import reading
from greenough.instrument.files import atomic_path, check_readable

from .reconstruct import PointMap

if TYPE_CHECKING:
    from xarray import Dataset

_FACT = "comment greenough "
_PLY_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
_MAX_HEADER = 1 << 16
_MAX_BYTES = 4 * 2**30
_MAX_BYTES_OF_OTHERS = 2**29  # text and other formats take up to 14 times their size in memory
_ENDINGS = (".ply", ".stl", ".obj", ".off", ".xyz")  # no archives, which may unpack to anything
_MAX_PIXEL = 2**24
_MAX_MM = 1e9


@dataclass(frozen=True)
class PointCloud:
    """Points with the camera pixels that saw them.

    Parameters
    ----------
    xyz : (n, 3) float64
        In the calibrated frame, mm.
    pixels : (n, 2) int32 or None
        (row, col) of the camera.
    smooth : (n,) bool or None
        Where the surface is smooth over the optical resolution: only somebody who knows the truth can say.
    noise_mm : (n, 3) float32 or None
        Standard uncertainty of x, y and z by noise.
    calibration_mm : (n, 3) float32 or None
        The same by the calibration and drifts, which neighbouring points share.
    intensity : (n,) float32 or None
        How bright the pixel was, above the black level: the fringes' mean, DN.
    normals : (n, 3) float32 or None
        Unit normals; zero where none is known.
    facts : mapping of str to str
        What the header says about the cloud.
    """

    xyz: np.ndarray
    pixels: np.ndarray | None = None
    smooth: np.ndarray | None = None
    noise_mm: np.ndarray | None = None
    calibration_mm: np.ndarray | None = None
    intensity: np.ndarray | None = None
    normals: np.ndarray | None = None
    facts: Mapping[str, str] = field(default_factory=dict)

    def to_xarray(self) -> "Dataset":
        """See `datasets.point_cloud_dataset`."""
        from .datasets import point_cloud_dataset

        return point_cloud_dataset(self)

    def _repr_html_(self) -> str:
        from .notebook import point_cloud_html

        return point_cloud_html(self)

    @classmethod
    def from_point_map(
        cls, point_map: PointMap, smooth: np.ndarray | None = None, facts: Mapping[str, object] | None = None
    ) -> "PointCloud":
        """The valid points of a map, row by row, with their uncertainties and brightness if it has any.

        ``smooth`` is (rows, cols) bool.
        """
        valid = point_map.valid
        known = point_map.noise_mm is not None and point_map.uncertainty is not None
        return cls(
            xyz=point_map.xyz[valid],
            pixels=np.argwhere(valid).astype(np.int32),
            smooth=None if smooth is None else smooth[valid],
            noise_mm=point_map.sigma_noise[valid] if known else None,
            calibration_mm=point_map.sigma_calibration[valid] if known else None,
            intensity=None if point_map.intensity is None else point_map.intensity[valid],
            facts={key: str(value) for key, value in (facts or {}).items()},
        )


@dataclass(frozen=True)
class Mesh:
    """Triangles.

    Parameters
    ----------
    vertices : (n, 3) float64
        In mm.
    faces : (m, 3) int32
        Counter-clockwise seen from outside.
    """

    vertices: np.ndarray
    faces: np.ndarray


def write_cloud(path: str | Path, cloud: PointCloud) -> None:
    """Write a point cloud as PLY; the file appears whole or not at all."""
    columns = [("x", "<f8", cloud.xyz[:, 0]), ("y", "<f8", cloud.xyz[:, 1]), ("z", "<f8", cloud.xyz[:, 2])]
    if cloud.normals is not None:
        columns += [(f"n{axis}", "<f4", cloud.normals[:, k]) for k, axis in enumerate("xyz")]
    if cloud.intensity is not None:
        columns.append(("intensity", "<f4", cloud.intensity))
    if cloud.smooth is not None:
        columns.append(("smooth", "u1", cloud.smooth))
    if cloud.pixels is not None:
        columns += [("row", "<i4", cloud.pixels[:, 0]), ("col", "<i4", cloud.pixels[:, 1])]
    for cause, sd in (("noise", cloud.noise_mm), ("calibration", cloud.calibration_mm)):
        if sd is not None:
            columns += [(f"sigma_{cause}_{axis}", "<f4", sd[:, k]) for k, axis in enumerate("xyz")]
    table = np.empty(len(cloud.xyz), dtype=[(name, kind) for name, kind, _ in columns])
    for name, _, values in columns:
        table[name] = values
    named = {"<f8": "double", "<f4": "float", "u1": "uchar", "<i4": "int"}
    header = [f"element vertex {len(table)}", *(f"property {named[kind]} {name}" for name, kind, _ in columns)]
    _write_ply(path, header, cloud.facts, [table])


def write_mesh(path: str | Path, mesh: Mesh, facts: Mapping[str, object] | None = None) -> None:
    """Write a mesh as PLY; the file appears whole or not at all."""
    faces = np.empty(len(mesh.faces), dtype=[("count", "u1"), ("corners", "<i4", 3)])
    faces["count"], faces["corners"] = 3, mesh.faces
    header = [
        f"element vertex {len(mesh.vertices)}",
        *(f"property double {axis}" for axis in "xyz"),
        f"element face {len(faces)}",
        "property list uchar int vertex_indices",
    ]
    _write_ply(path, header, facts or {}, [np.ascontiguousarray(mesh.vertices, dtype="<f8"), faces])


def read_cloud(path: str | Path) -> PointCloud:
    """Read a point cloud from PLY: ours or anybody's that has x, y and z.

    Points with NaN coordinates are left out.

    Raises
    ------
    InputError
        If the file is missing, no PLY, truncated, larger than 4 GiB, or has no points, or has impossible ones.
    """
    path = Path(path)
    header = _read_header(path)
    table = _read_table_with_trimesh(path, None) if header is None else _read_vertices(path, header)
    names = table.dtype.names or ()
    if not {"x", "y", "z"} <= set(names):
        raise InputError(f"the point cloud {path} has no x, y and z: it has {', '.join(names) or 'nothing'}")
    xyz = np.stack([table[axis].astype(np.float64) for axis in "xyz"], axis=-1)
    finite = np.isfinite(xyz).all(axis=-1)
    if not finite.any():
        raise InputError(f"the point cloud {path} has no points")
    table, xyz = table[finite], xyz[finite]
    if np.abs(xyz).max() > _MAX_MM:
        raise InputError(f"the point cloud {path} has points further out than {_MAX_MM:g} mm: leave them out")
    return PointCloud(
        xyz=xyz,
        pixels=_pixels(path, table) if {"row", "col"} <= set(names) else None,
        smooth=table["smooth"].astype(bool) if "smooth" in names else None,
        noise_mm=_triple(table, "sigma_noise_"),
        calibration_mm=_triple(table, "sigma_calibration_"),
        intensity=table["intensity"].astype(np.float32) if "intensity" in names else None,
        normals=_triple(table, "n"),
        facts={} if header is None else header.facts,
    )


def read_mesh(path: str | Path) -> Mesh:
    """Read a triangle mesh in mm.

    Raises
    ------
    InputError
        If the file is missing, cannot be read, is larger than 4 GiB (512 MiB if it is no binary PLY), has no faces, or
        has vertices that are not finite.
    """
    path = Path(path)
    header = _read_header(path)
    mesh = _read_triangles(path, header) if header is not None else None
    if mesh is None:
        _check_size(path, _MAX_BYTES_OF_OTHERS)
        try:
            with reading(path):
                loaded = trimesh.load_mesh(path, skip_materials=True)
            mesh = Mesh(np.asarray(loaded.vertices, dtype=np.float64), np.asarray(loaded.faces, dtype=np.int32))
        except FileError:
            raise
        except Exception as error:  # trimesh raises whatever its format readers meet
            raise InputError(f"the mesh {path} cannot be read ({error}): give a PLY, STL or OBJ file") from None
    if len(mesh.faces) == 0:
        raise InputError(f"the mesh {path} has no faces: give a surface, not points")
    if not np.isfinite(mesh.vertices).all():
        raise InputError(f"the mesh {path} has vertices that are not finite: repair it")
    if mesh.faces.min() < 0 or mesh.faces.max() >= len(mesh.vertices):
        raise InputError(f"the mesh {path} has faces that name vertices it does not have: repair it")
    return mesh


def _pixels(path: Path, table: np.ndarray) -> np.ndarray:
    """Rows and columns (n, 2) int32 that a table states."""
    pixels = np.stack([table["row"], table["col"]], axis=-1)
    if not (np.abs(pixels) < _MAX_PIXEL).all():  # nor NaN
        raise InputError(
            f"the point cloud {path} has a row or col that no camera has: at most {_MAX_PIXEL} are counted"
        )
    return pixels.astype(np.int32)


def _triple(table: np.ndarray, prefix: str) -> np.ndarray | None:
    """Three columns named so, ending with x, y and z, (n, 3) float32; None if one is missing."""
    names = [f"{prefix}{axis}" for axis in "xyz"]
    if not set(names) <= set(table.dtype.names or ()):
        return None
    return np.stack([table[name] for name in names], axis=-1).astype(np.float32)


@dataclass(frozen=True)
class _Header:
    """What the header of a PLY says; types are None for layouts that numpy cannot map."""

    binary: bool  # and little-endian
    length: int
    facts: dict[str, str]
    vertices: int
    vertex_type: np.dtype | None
    faces: int
    face_type: np.dtype | None
    in_order: bool  # vertices first, then faces


def _write_ply(path: str | Path, header: list[str], facts: Mapping[str, object], arrays: list[np.ndarray]) -> None:
    lines = ["ply", "format binary_little_endian 1.0"]
    for key, value in facts.items():
        text = f"{_FACT}{key}={value}"
        if len(text.splitlines()) != 1 or "=" in key:
            raise ValueError(f"{text!r} does not fit a PLY header line")
        lines.append(text)
    lines += [*header, "end_header"]
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        file.write(("\n".join(lines) + "\n").encode("ascii", errors="backslashreplace"))
        for array in arrays:
            file.write(np.ascontiguousarray(array).data)


def _read_header(path: Path) -> _Header | None:
    """The header of a PLY file, or None if it is none."""
    check_readable(path, missing=f"there is no file {path}")
    if path.suffix.lower() not in _ENDINGS:
        raise InputError(f"points and meshes are read from {', '.join(_ENDINGS)}, and {path} has none of these endings")
    _check_size(path, _MAX_BYTES)
    with reading(path), open(path, "rb") as file:
        start = file.read(_MAX_HEADER)
    if not start.startswith(b"ply"):
        return None
    end = start.find(b"end_header")
    newline = start.find(b"\n", end)
    if end < 0 or newline < 0:
        raise InputError(f"the PLY file {path} is damaged: its header does not end")
    lines = start[:end].decode("ascii", errors="replace").splitlines()
    facts: dict[str, str] = {}
    elements: list[tuple[str, int, list[list[str]]]] = []
    try:
        for line in map(str.strip, lines):
            if line.startswith(_FACT):
                key, _, value = line.removeprefix(_FACT).partition("=")
                facts[key] = value
            elif line.startswith("element "):
                _, name, count = line.split()
                elements.append((name, int(count), []))
                if int(count) < 0:
                    raise ValueError
            elif line.startswith("property "):
                elements[-1][2].append(line.split()[1:])
        counts = {name: count for name, count, _ in elements}
        types = {name: _element_type(properties) for name, _, properties in elements}
    except (ValueError, IndexError, KeyError):
        raise InputError(f"the PLY file {path} is damaged: its header cannot be understood") from None
    return _Header(
        binary="format binary_little_endian 1.0" in (line.strip() for line in lines),
        length=newline + 1,
        facts=facts,
        vertices=counts.get("vertex", 0),
        vertex_type=types.get("vertex"),
        faces=counts.get("face", 0),
        face_type=types.get("face"),
        in_order=[name for name, _, _ in elements][:2] in (["vertex"], ["vertex", "face"]),
    )


def _element_type(properties: list[list[str]]) -> np.dtype | None:
    """Record type of an element; a face's list is taken to hold three corners. None if there are other lists."""
    fields: list[tuple] = []
    for words in properties:
        if words[0] != "list":
            kind, name = words
            fields.append((name, "<" + _PLY_TYPES[kind]))
        elif words[-1] in ("vertex_indices", "vertex_index") and len(properties) == 1:
            _, count, index, _ = words
            fields += [("count", "<" + _PLY_TYPES[count]), ("corners", "<" + _PLY_TYPES[index], 3)]
        else:
            return None
    return np.dtype(fields)


def _read_vertices(path: Path, header: _Header) -> np.ndarray:
    if not (header.binary and header.in_order and header.vertex_type):
        return _read_table_with_trimesh(path, header.vertices)
    needed = header.length + header.vertices * header.vertex_type.itemsize
    if path.stat().st_size < needed:
        raise InputError(f"the PLY file {path} is truncated: {path.stat().st_size} bytes of at least {needed}")
    with reading(path):
        return np.fromfile(path, dtype=header.vertex_type, count=header.vertices, offset=header.length)


def _read_triangles(path: Path, header: _Header) -> Mesh | None:
    """The mesh of a binary PLY of triangles, or None if its layout needs a general reader."""
    if not (header.binary and header.in_order and header.vertex_type and header.face_type):
        return None
    names = header.vertex_type.names or ()
    if not {"x", "y", "z"} <= set(names):
        return None
    table = _read_vertices(path, header)
    offset = header.length + table.nbytes
    there = (path.stat().st_size - offset) // header.face_type.itemsize
    if header.faces and not there:
        raise InputError(f"the PLY file {path} is truncated: its faces are missing")
    with reading(path):
        faces = np.fromfile(path, dtype=header.face_type, count=min(header.faces, there), offset=offset)
    if len(faces) < header.faces or not np.all(faces["count"] == 3):
        if np.all(faces["count"] == 3):
            raise InputError(f"the PLY file {path} is truncated: {len(faces)} of {header.faces} faces are there")
        return None  # polygons
    vertices = np.stack([table[axis].astype(np.float64) for axis in "xyz"], axis=-1)
    return Mesh(vertices, faces["corners"].astype(np.int32))


def _check_size(path: Path, limit: int) -> None:
    if path.stat().st_size > limit:
        raise InputError(
            f"{path} has {path.stat().st_size / 2**30:.3g} GiB, and {limit / 2**30:g} GiB are read: divide it"
        )


def _read_table_with_trimesh(path: Path, claimed: int | None) -> np.ndarray:
    """x, y and z of every vertex, of which a PLY's header claims so many."""
    _check_size(path, _MAX_BYTES_OF_OTHERS)
    try:
        with reading(path):
            loaded: Any = trimesh.load(path, process=False)
        points = np.asarray(loaded.vertices, dtype=np.float64)
    except FileError:
        raise
    except Exception as error:  # trimesh raises whatever its format readers meet
        raise InputError(f"the point cloud {path} cannot be read ({error}): give a PLY file") from None
    if claimed is not None and len(points) != claimed:
        raise InputError(f"the PLY file {path} is truncated: {len(points)} of {claimed} points are there")
    table = np.empty(len(points), dtype=[(axis, "<f8") for axis in "xyz"])
    for axis, values in zip("xyz", points.T, strict=True):
        table[axis] = values
    return table
