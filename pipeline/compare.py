"""Comparison of measured points with the mesh that they should lie on."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import igl
import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

from greenough.instrument.errors import InputError

from .point_cloud import Mesh, PointCloud

Alignment = Literal["none", "rigid", "similarity"]
ALIGNMENTS: tuple[Alignment, ...] = ("none", "rigid", "similarity")

_ALIGNING_POINTS = 20_000
_UNDETERMINED = 1e-3  # a motion that moves the distances less than this share of the stiffest one is left at zero
_SETTLED_MM = 1e-7
_MAX_ITERATIONS = 60
_ON_EDGE = 1e-9  # barycentric


@dataclass(frozen=True)
class ErrorRow:
    """Statistics of one kind of error over some points; lengths in µm.

    Parameters
    ----------
    quantity : "signed_distance" or "vertical"
        Along the surface normal, positive outside (above); or z of the point minus z of the mesh's uppermost surface on
        the same (x, y).
    points : "all" or "smooth"
    n : int
        Points that count: a vertical error exists only where the mesh lies below or above the point.
    bias_um, rmse_um : float
    p95_um, max_um : float
        Of the absolute value.
    """

    quantity: str
    points: str
    n: int
    bias_um: float
    rmse_um: float
    p95_um: float
    max_um: float


@dataclass(frozen=True)
class Comparison:
    """What `compare` found.

    Parameters
    ----------
    alignment : "none", "rigid" or "similarity"
    transform : (4, 4) float64
        What the alignment did to the points, scale included.
    rows : sequence of ErrorRow
    points : int
        Points of the cloud.
    valid_share : float or None
        Points of the cloud over those that truth says are lit and seen, where the cloud states that number.
    """

    alignment: Alignment
    transform: np.ndarray
    rows: Sequence[ErrorRow]
    points: int
    valid_share: float | None

    def _repr_html_(self) -> str:
        from .notebook import comparison_html

        return comparison_html(self)

    def row(self, quantity: str, points: str = "all") -> ErrorRow:
        """The row of a quantity; KeyError if there is none."""
        for row in self.rows:
            if (row.quantity, row.points) == (quantity, points):
                return row
        raise KeyError((quantity, points))

    def within(self, tolerance_um: float) -> bool:
        """Whether 95 % of all vertical errors stay within a tolerance; not if there are none."""
        return bool(self.row("vertical").p95_um <= tolerance_um)


def compare(cloud: PointCloud, mesh: Mesh, align: Alignment = "none") -> Comparison:
    """Compare a point cloud with a mesh.

    Parameters
    ----------
    cloud : PointCloud
        Where it knows its smooth points, these get rows of their own; where its facts state ``lit_and_seen``, the
        valid share is given.
    mesh : Mesh
        Faces counter-clockwise seen from above or outside.
    align : "none", "rigid" or "similarity"
        Motion of the points that minimises the squared distances along the normals; none is applied unless asked.

    Raises
    ------
    InputError
        If the mesh has no triangle of positive area or ``lit_and_seen`` is no count.
    """
    surface = Surface.of(mesh)
    transform = np.eye(4) if align == "none" else fit_motion(cloud.xyz, surface, scale=align == "similarity")
    xyz = cloud.xyz @ transform[:3, :3].T + transform[:3, 3]
    errors = {"signed_distance": signed_distances(xyz, surface), "vertical": vertical_errors(xyz, surface)}
    selections = {"all": np.ones(len(xyz), dtype=bool)}
    if cloud.smooth is not None:
        selections["smooth"] = cloud.smooth
    rows = [
        error_row(quantity, points, error[selected])
        for points, selected in selections.items()
        for quantity, error in errors.items()
    ]
    return Comparison(align, transform, rows, len(xyz), _valid_share(cloud))


@dataclass(frozen=True, eq=False)
class Surface:
    """A mesh made ready for queries: equal vertices made one, triangles without area left out.

    Parameters
    ----------
    vertices : (n, 3) float64
    faces : (m, 3) int64
    normals : (m, 3) float64
        Unit normals of the faces.
    """

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray

    @classmethod
    def of(cls, mesh: Mesh) -> "Surface":
        """Prepare a mesh; InputError if it has no triangle of positive area."""
        vertices, faces = _weld(mesh.vertices, mesh.faces)
        normals = _cross_edges(vertices, faces)
        area = np.sqrt(np.einsum("nk,nk->n", normals, normals))
        solid = area > 0
        if not solid.any():
            raise InputError("the mesh has no triangle of positive area: give a surface")
        return cls(vertices, np.ascontiguousarray(faces[solid]), normals[solid] / area[solid, None])

    @cached_property
    def tree(self) -> igl.AABB:
        """For closest points."""
        tree = igl.AABB()
        tree.init(self.vertices, self.faces)
        return tree

    @cached_property
    def scene(self) -> EmbreeScene:
        """For rays."""
        scene = EmbreeScene(robust=True)  # otherwise some rays slip between neighbouring triangles
        TriangleMesh(scene, self.vertices.astype(np.float32), self.faces.astype(np.int32))
        return scene

    def closest(self, xyz: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Distance (n,), face index (n,) and position (n, 3) of the closest point of the surface to each point."""
        square, face, position = self.tree.squared_distance(self.vertices, self.faces, np.ascontiguousarray(xyz))
        return np.sqrt(square), np.asarray(face), np.asarray(position)


def signed_distances(xyz: np.ndarray, surface: Surface) -> np.ndarray:
    """Distance of points (n, 3) to a surface in mm, positive outside (above), (n,).

    The sign is that of the pseudonormal at the closest point (Bærentzen and Aanæs 2005): the normal of the face, the
    sum of the normals of the two faces at an edge, the angle-weighted sum of the normals at a vertex.
    """
    distance, face, position = surface.closest(xyz)
    normal = surface.normals[face]
    share = _barycentric(position, surface.vertices[surface.faces[face]])  # (n, 3)
    at_rim = np.flatnonzero(share.min(axis=1) < _ON_EDGE)
    normal[at_rim] = _rim_pseudonormals(surface, surface.faces[face[at_rim]], share[at_rim] >= _ON_EDGE)
    return np.where(np.einsum("nk,nk->n", xyz - position, normal) < 0, -distance, distance)


def vertical_errors(xyz: np.ndarray, surface: Surface) -> np.ndarray:
    """z of points (n, 3) minus z of the uppermost surface on the same (x, y), mm; NaN where there is none, (n,)."""
    origins = xyz.astype(np.float32)
    origins[:, 2] = surface.vertices[:, 2].max() + 1.0
    down = np.tile(np.array([0, 0, -1], dtype=np.float32), (len(xyz), 1))
    face = surface.scene.run(origins, down)
    errors = np.full(len(xyz), np.nan)
    hit = np.flatnonzero((face >= 0) & (surface.normals[face, 2] != 0))
    # The ray tracer's single precision only chooses the triangle; its plane is evaluated in double.
    normal, corner = surface.normals[face[hit]], surface.vertices[surface.faces[face[hit], 0]]
    errors[hit] = np.einsum("nk,nk->n", xyz[hit] - corner, normal) / normal[:, 2]
    return errors


def fit_motion(xyz: np.ndarray, surface: Surface, scale: bool) -> np.ndarray:
    """Rigid motion, or similarity, that takes points best onto a surface, (4, 4).

    Iterated closest points with the distance along the normal of the closest triangle, over a regular sample of the
    points. Motions that the surface does not resist (sliding along a plane, turning about an axis of symmetry) are left
    at zero.
    """
    sample = np.ascontiguousarray(xyz[:: max(1, len(xyz) // _ALIGNING_POINTS)])
    centre = sample.mean(axis=0)
    radius = np.sqrt(np.mean(np.sum((sample - centre) ** 2, axis=1))) or 1.0
    transform = np.eye(4)
    for _ in range(_MAX_ITERATIONS):
        moved = sample @ transform[:3, :3].T + transform[:3, 3]
        _, face, closest = surface.closest(moved)
        normal = surface.normals[face]
        arm = (moved - centre) / radius
        # Columns: rotation about x, y, z, translation along x, y, z, and scale, all as lengths at the cloud's radius.
        columns = [np.cross(arm, normal), normal]
        if scale:
            columns.append(np.einsum("nk,nk->n", arm, normal)[:, None])
        distance = np.einsum("nk,nk->n", moved - closest, normal)
        step = np.linalg.lstsq(np.hstack(columns), -distance, rcond=_UNDETERMINED)[0]
        factor = np.exp(step[6] / radius) if scale else 1.0
        motion = np.eye(4)
        motion[:3, :3] = factor * _rotation(step[:3] / radius)
        motion[:3, 3] = centre + step[3:6] - motion[:3, :3] @ centre
        transform = motion @ transform
        if np.linalg.norm(step) < _SETTLED_MM:
            break
    return transform


def _rotation(vector: np.ndarray) -> np.ndarray:
    """Rodrigues' formula."""
    angle = np.linalg.norm(vector)
    x, y, z = vector / (angle or 1.0)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def _weld(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices with equal ones made one, and the faces that name them so."""
    # Sorted along one skew line, equal vertices become neighbours.
    order = np.argsort(vertices[:, 0] + 0.6180339887 * vertices[:, 1] + 0.4142135624 * vertices[:, 2], kind="stable")
    ordered = vertices[order]
    first = np.ones(len(order), dtype=bool)
    first[1:] = np.any(ordered[1:] != ordered[:-1], axis=1)
    new_index = np.empty(len(order), dtype=np.int64)
    new_index[order] = np.cumsum(first) - 1
    return np.ascontiguousarray(ordered[first], dtype=np.float64), new_index[faces]


def _cross_edges(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    return np.cross(b - a, c - a)


def _barycentric(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Barycentric coordinates (n, 3) of points (n, 3) on triangles (n, 3, 3)."""
    a, b, c = np.moveaxis(corners, 1, 0)
    u, v, w = b - a, c - a, points - a

    def dot(p: np.ndarray, q: np.ndarray) -> np.ndarray:
        return np.einsum("nk,nk->n", p, q)

    uu, uv, vv, wu, wv = dot(u, u), dot(u, v), dot(v, v), dot(w, u), dot(w, v)
    determinant = uu * vv - uv * uv
    second, third = (vv * wu - uv * wv) / determinant, (uu * wv - uv * wu) / determinant
    return np.stack([1 - second - third, second, third], axis=-1)


def _rim_pseudonormals(surface: Surface, corners: np.ndarray, touches: np.ndarray) -> np.ndarray:
    """Sums of face normals at edges and vertices.

    Parameters
    ----------
    surface : Surface
    corners : (n, 3) int
        Vertices of the closest face of each point.
    touches : (n, 3) bool
        Which of them span the edge that the closest point lies on (two), or are the closest point (one).
    """
    involved = np.zeros(len(surface.vertices), dtype=bool)
    involved[corners[touches]] = True
    near = np.flatnonzero(involved[surface.faces].any(axis=1))
    faces, normals = surface.faces[near], surface.normals[near]
    at_vertex = np.zeros((len(surface.vertices), 3))
    edge_keys, edge_normals = [], []
    for i in range(3):
        here, onwards, back = faces[:, i], faces[:, (i + 1) % 3], faces[:, (i + 2) % 3]
        p, q = surface.vertices[onwards] - surface.vertices[here], surface.vertices[back] - surface.vertices[here]
        angle = np.arctan2(np.linalg.norm(np.cross(p, q), axis=1), np.einsum("nk,nk->n", p, q))
        np.add.at(at_vertex, here, angle[:, None] * normals)
        edge_keys.append(_edge_key(here, onwards, len(surface.vertices)))
        edge_normals.append(normals)
    keys, which = np.unique(np.concatenate(edge_keys), return_inverse=True)
    at_edge = np.zeros((len(keys), 3))
    np.add.at(at_edge, which, np.concatenate(edge_normals))

    result = np.empty((len(corners), 3))
    on_edge = touches.sum(axis=1) == 2
    ends = corners[on_edge][touches[on_edge]].reshape(-1, 2)
    result[on_edge] = at_edge[np.searchsorted(keys, _edge_key(ends[:, 0], ends[:, 1], len(surface.vertices)))]
    result[~on_edge] = at_vertex[corners[~on_edge][touches[~on_edge]]]
    return result


def _edge_key(start: np.ndarray, end: np.ndarray, vertices: int) -> np.ndarray:
    return np.minimum(start, end) * vertices + np.maximum(start, end)


def error_row(quantity: str, points: str, errors_mm: np.ndarray) -> ErrorRow:
    """Statistics of errors (n,); those that are NaN do not count, and without any others all figures are NaN."""
    errors_um = 1e3 * errors_mm[np.isfinite(errors_mm)]
    if len(errors_um) == 0:
        return ErrorRow(quantity, points, 0, *[float("nan")] * 4)
    size = np.abs(errors_um)
    return ErrorRow(
        quantity=quantity,
        points=points,
        n=len(errors_um),
        bias_um=float(errors_um.mean()),
        rmse_um=float(np.sqrt(np.mean(errors_um**2))),
        p95_um=float(np.quantile(size, 0.95)),
        max_um=float(size.max()),
    )


def _valid_share(cloud: PointCloud) -> float | None:
    stated = cloud.facts.get("lit_and_seen")
    if stated is None:
        return None
    if not stated.isdigit() or int(stated) == 0:
        raise InputError(f"the point cloud states lit_and_seen={stated}: it must be a positive count")
    return len(cloud.xyz) / int(stated)
