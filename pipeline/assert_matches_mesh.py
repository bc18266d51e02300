"""One line that tests a measurement against the mesh it should lie on, and draws what is wrong if it does not."""

import hashlib
import os
import re
import warnings
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from greenough.instrument.errors import InputError

from .compare import Alignment, Comparison, Surface, compare, vertical_errors
from .point_cloud import Mesh, PointCloud, read_cloud, read_mesh
from .reconstruct import PointMap

if TYPE_CHECKING:
    from trimesh import Trimesh

PICTURES = "greenough-failures"
"""Folder that pictures go to unless another is named."""

_OTHER_UNIT = 30.0  # a cloud so much larger or smaller than its mesh is in another unit


def assert_matches_mesh(
    cloud: PointCloud | PointMap | np.ndarray | str | Path,
    mesh: "Mesh | Trimesh | str | Path",
    tolerance_um: float = 4.0,
    align: Alignment = "none",
    pictures: str | Path = PICTURES,
) -> Comparison:
    """Assert that 95 % of a cloud's vertical errors stay within a tolerance, as `greenough compare` judges.

    Parameters
    ----------
    cloud : PointCloud, PointMap, (..., 3) array in mm with NaN where there is no point, or path
    mesh : Mesh, trimesh.Trimesh in mm, or path
    tolerance_um : float
        Above 0.
    align : "none", "rigid" or "similarity"
        Motion of the points before they are compared.
    pictures : str or Path
        Folder for the error map of a cloud that does not match. It is made when it is needed, and the file is named
        after the test that runs.

    Returns
    -------
    Comparison

    Raises
    ------
    AssertionError
        If the cloud does not match. It says by how much, where, what to do, and where the picture is.
    InputError
        If cloud, mesh or tolerance cannot be used.
    """
    __tracebackhide__ = True
    if not tolerance_um > 0:
        raise InputError(f"tolerance_um is {tolerance_um:g}: it must be above 0")
    points, surface = as_cloud(cloud), as_mesh(mesh)
    found = compare(points, surface, align)
    if found.within(tolerance_um):
        return found
    xyz = points.xyz @ found.transform[:3, :3].T + found.transform[:3, 3]
    errors_um = 1e3 * vertical_errors(xyz, Surface.of(surface))
    names = [str(given) if isinstance(given, str | Path) else type(given).__name__ for given in (cloud, mesh)]
    picture = _picture(Path(pictures), points, xyz, errors_um, tolerance_um, f"{names[0]} against {names[1]}")
    row = found.row("vertical")
    lines = [
        f"{names[0]} does not match {names[1]}: 95 % of the vertical errors are within {row.p95_um:.4g} µm, "
        f"allowed are {tolerance_um:g} µm",
        f"  bias {row.bias_um:.4g}, rms {row.rmse_um:.4g}, 95 % {row.p95_um:.4g}, largest {row.max_um:.4g} µm; "
        f"n = {row.n} of {len(xyz)} points, those above or below the mesh; alignment {align}",
    ]
    if row.n:
        lines.append(f"  worst: {_worst(points, xyz, errors_um)}")
    lines.append(f"  what to do: {_remedy(points, surface, found, tolerance_um)}")
    lines.append(f"  error map: {picture}")
    raise AssertionError("\n".join(lines))


def as_cloud(given: PointCloud | PointMap | np.ndarray | str | Path) -> PointCloud:
    """What `assert_matches_mesh` takes for a cloud, as one; InputError if it is none or has no points."""
    if isinstance(given, str | Path):
        return read_cloud(given)
    if isinstance(given, PointMap):
        given = PointCloud.from_point_map(given)
    if not isinstance(given, PointCloud):
        xyz = np.asarray(given, dtype=np.float64)
        if xyz.ndim < 2 or xyz.shape[-1] != 3:
            raise InputError(f"the points are of shape {xyz.shape}: give (n, 3) or (rows, cols, 3), in mm")
        finite = np.isfinite(xyz).all(axis=-1)
        given = PointCloud(xyz[finite], np.argwhere(finite).astype(np.int32) if xyz.ndim == 3 else None)
    if not len(given.xyz):
        raise InputError("the cloud has no points: nothing was measured")
    return given


def as_mesh(given: "Mesh | Trimesh | str | Path") -> Mesh:
    """What `assert_matches_mesh` takes for a mesh, as one."""
    if isinstance(given, str | Path):
        return read_mesh(given)
    return Mesh(np.asarray(given.vertices, dtype=np.float64), np.asarray(given.faces, dtype=np.int32))


def _worst(points: PointCloud, xyz: np.ndarray, errors_um: np.ndarray) -> str:
    index = int(np.nanargmax(np.abs(errors_um)))
    place = ", ".join(f"{value:.4f}" for value in xyz[index])
    pixel = "" if points.pixels is None else ", pixel (row {}, col {})".format(*points.pixels[index])
    return f"{errors_um[index]:+.4g} µm at ({place}) mm{pixel}"


def _remedy(points: PointCloud, mesh: Mesh, found: Comparison, tolerance_um: float) -> str:
    sizes = [
        float(np.linalg.norm(np.ptp(corners, axis=0))) for corners in (points.xyz, mesh.vertices[mesh.faces.ravel()])
    ]
    if sizes[0] > 0 and not 1 / _OTHER_UNIT < sizes[1] / sizes[0] < _OTHER_UNIT:
        return f"the points span {sizes[0]:.4g} mm and the mesh {sizes[1]:.4g} mm: save both in mm"
    if not found.row("vertical").n:
        return "no point lies above or below the mesh: move one of them into the frame of the other"
    if found.alignment == "none":
        aligned = compare(points, mesh, "rigid").row("vertical")
        if aligned.p95_um <= tolerance_um:
            return (
                f"the shape is right and lies elsewhere: aligned rigidly, 95 % are within {aligned.p95_um:.4g} µm. "
                'Move the mesh to where the part lay, or pass align="rigid" if the pose is not to be judged'
            )
        return (
            f"the shape differs, aligned rigidly 95 % are still within {aligned.p95_um:.4g} µm only: see in the map "
            "whether it is an edge, a slope or the whole surface, and check calibration, exposure and mesh"
        )
    return (
        "the shape differs: see in the map whether it is an edge, a slope or the whole surface, and check calibration, "
        "exposure and mesh"
    )


def _picture(
    folder: Path, points: PointCloud, xyz: np.ndarray, errors_um: np.ndarray, tolerance_um: float, title: str
) -> str:
    """Draw the error map; returns where it is, or why there is none: the figures must not be lost with it."""
    from .error_map import write_error_map

    running = os.environ.get("PYTEST_CURRENT_TEST")
    test = title if running is None else running.rpartition(" (")[0]  # without "(call)"
    name = re.sub(r"[^\w.=-]+", "-", test, flags=re.ASCII).strip("-.")[-100:]
    name = f"{name}-{hashlib.sha256(test.encode()).hexdigest()[:6]}.png"  # names that differ in other signs alone
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with warnings.catch_warnings():  # which may be errors in somebody's tests
            warnings.simplefilter("ignore")
            write_error_map(folder / name, xyz, errors_um, tolerance_um, title, points.pixels)
    except (OSError, InputError) as error:
        return f"none ({error})"
    return str((folder / name).absolute())
