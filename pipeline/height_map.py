"""A regular height map from points that lie irregularly in x and y, as those of a camera's pixels do."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from greenough.instrument.errors import InputError

from .point_cloud import PointCloud
from .surface_mesh import surface_mesh

_FINEST = 10  # nodes between two pixels at most: there is nothing to be seen between them
_MAX_NODES = 2**26
_CHUNK = 2**20  # nodes that are tried at a time
_ON_EDGE = 1e-9  # barycentric
_NO_AREA = 1e-9  # of the middle area: triangles that are seen edge-on


@dataclass(frozen=True, eq=False)
class HeightMap:
    """Heights over a square grid, as seen from above: x grows with the column, and y falls with the row.

    Parameters
    ----------
    z : (rows, cols) float64
        mm; NaN for voids.
    pitch : float
        From node to node along x and along y, mm.
    left, top : float
        x of the first column and y of the first row, mm.
    facts : mapping of str to str
        What is known about the points.
    """

    z: np.ndarray
    pitch: float
    left: float
    top: float
    facts: Mapping[str, str] = field(default_factory=dict)

    @property
    def bottom(self) -> float:
        """y of the last row, mm."""
        return self.top - (len(self.z) - 1) * self.pitch

    @property
    def voids(self) -> np.ndarray:
        """(rows, cols) bool: nodes without a height."""
        return np.isnan(self.z)


def height_map(cloud: PointCloud, pitch_mm: float | None = None) -> HeightMap:
    """Heights at the nodes of a regular grid, linear inside the triangles between neighbouring pixels (`surface_mesh`).

    A node that lies in no triangle is a void: nothing is made up across what was not measured. Where a node lies in
    several, as under an overhang, the uppermost counts. Nodes lie at whole multiples of the pitch, so that maps of one
    pitch have common nodes and can be subtracted. A pitch that is coarser than the pixels leaves points out and does
    not average. Inside a triangle the noise of its three corners is averaged, to 1/√3 at the most.

    Parameters
    ----------
    cloud : PointCloud
        With its pixels.
    pitch_mm : float, optional
        The cloud's own sampling if left out: the square root of the area, seen from above, that is between four
        neighbouring pixels, in the median.

    Raises
    ------
    InputError
        When the points are no surface, the pitch is below a tenth of the cloud's sampling or above its extent, the grid
        would have more than 2²⁶ nodes, or less than two rows or columns of nodes lie on the surface.
    """
    mesh = surface_mesh(cloud)
    x, y, z = np.ascontiguousarray(mesh.vertices.T)[:, mesh.faces.T]  # (3 corners, triangles) each
    areas = np.abs((x[1] - x[0]) * (y[2] - y[0]) - (x[2] - x[0]) * (y[1] - y[0]))  # of squares: two triangles each
    sampling = float(np.sqrt(np.median(areas)))
    pitch = sampling if pitch_mm is None else pitch_mm
    extent = float(min(np.ptp(x), np.ptp(y)))
    if not (pitch > 0 and sampling / _FINEST <= pitch <= extent):
        finest, coarsest = 1e3 * sampling / _FINEST, 1e3 * extent
        raise InputError(
            f"a height map with a pitch of {1e3 * pitch:g} µm: it must lie between {finest:.3g} µm, a tenth of how far "
            f"the points are apart as seen from above, and {coarsest:.3g} µm, the extent of them all"
        )
    x, y = x / pitch, y / pitch
    left, low = np.floor(x.min()), np.floor(y.min())
    cols, rows = np.ceil(x.max()) - left + 1, np.ceil(y.max()) - low + 1
    if not rows * cols <= _MAX_NODES:
        raise InputError(
            f"a height map of {cols:.0f} x {rows:.0f} nodes {1e3 * pitch:.4g} µm apart; at most {_MAX_NODES} are made: "
            "choose a larger pitch, or leave points out that lie far from the rest"
        )
    heights = np.full((int(rows), int(cols)), np.nan)
    solid = areas > _NO_AREA * sampling**2
    _raise_to(heights, x[:, solid] - left, y[:, solid] - low, z[:, solid])
    seen = ~np.isnan(heights)
    if min(seen.any(axis=0).sum(), seen.any(axis=1).sum()) < 2:
        raise InputError(
            f"a height map with a pitch of {1e3 * pitch:g} µm has no two rows and columns: choose a finer one"
        )
    (first_row, last_row), (first_col, last_col) = (np.flatnonzero(seen.any(axis=axis))[[0, -1]] for axis in (1, 0))
    return HeightMap(
        z=np.ascontiguousarray(heights[first_row : last_row + 1, first_col : last_col + 1][::-1]),
        pitch=pitch,
        left=float(left + first_col) * pitch,
        top=float(low + last_row) * pitch,
        facts=cloud.facts,
    )


def _raise_to(heights: np.ndarray, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> None:
    """Raise heights (rows, cols), whose rows go up, to triangles (3 corners, n) with x and y in nodes."""
    first = [np.ceil(axis.min(axis=0)).astype(np.int64) for axis in (x, y)]
    counts = [
        np.floor(axis.max(axis=0)).astype(np.int64) - start + 1 for axis, start in zip((x, y), first, strict=True)
    ]
    hit = (counts[0] > 0) & (counts[1] > 0)
    tried = counts[0][hit] * counts[1][hit]  # nodes in the box around each triangle
    if tried.max(initial=0) > _CHUNK:
        raise InputError("a height map of points that lie almost on a line as seen from above: there is no surface")
    x, y, z, left, low, wide = x[:, hit], y[:, hit], z[:, hit], first[0][hit], first[1][hit], counts[0][hit]
    ends = np.flatnonzero(np.diff(np.cumsum(tried) // _CHUNK)) + 1
    for part in np.split(np.arange(len(tried)), ends):
        which = np.repeat(part, tried[part])
        within = np.arange(len(which)) - np.repeat(np.cumsum(tried[part]) - tried[part], tried[part])
        row, col = low[which] + within // wide[which], left[which] + within % wide[which]
        inside, height = _height_on(x[:, which], y[:, which], z[:, which], col, row)
        np.fmax.at(heights, (row[inside], col[inside]), height[inside])


def _height_on(
    x: np.ndarray, y: np.ndarray, z: np.ndarray, at_x: np.ndarray, at_y: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Whether places (n,) lie in triangles (3 corners, n), and the height there, by barycentric coordinates."""
    bx, by, bz = x[1] - x[0], y[1] - y[0], z[1] - z[0]
    cx, cy, cz = x[2] - x[0], y[2] - y[0], z[2] - z[0]
    px, py = at_x - x[0], at_y - y[0]
    area = bx * cy - cx * by
    b, c = (px * cy - py * cx) / area, (py * bx - px * by) / area
    # A node on an edge belongs to the triangles on both sides, which agree there.
    return (b >= -_ON_EDGE) & (c >= -_ON_EDGE) & (b + c <= 1 + _ON_EDGE), z[0] + b * bz + c * cz
