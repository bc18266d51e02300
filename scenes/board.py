"""The calibration board as it was printed: white ceramic spots in a dark ink, and its blank reverse side.

Frame: the one of :class:`greenough.instrument.contract.SpotBoard`. z = 0 is the best plane of the ceramic through the
spots, z points out of the face that is up; origin and x axis are those of the nominal spots best-fitted to the printed
ones. The ink lies on the ceramic, so only the spots are at z = 0.

The blank face is given in the frame of the board turned over about its y axis: z = 0 is parallel to the printed face,
which now lies on the table, and the blank face slopes against it by the wedge.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from greenough.instrument.contract import SpotBoard
from greenough.instrument.errors import InputError

from .parts import Part, Specimen
from .triangulation import grid_faces, grid_points, ring_faces

_SPOT_SAGITTA_MM = 5e-5  # between a spot's circle and the sides of its polygon

# Long slivers from a spot's middle to its circle, and on to the border of its cell, would cost rays the most: each ray
# meets many. Instead rings of ever fewer points follow each other inwards and outwards.
_FAN = 18  # most points of the ring that is left for a fan around the middle
_RINGS = (1 / 16, 1 / 4)  # of half and a quarter of the circle's points: shares of the way from there to the border
_BORDER = 2  # corners of the border for each eighth of the way round


@dataclass(frozen=True)
class BoardErrors:
    """How well boards are made.

    Parameters
    ----------
    print_sd_um : float
        Standard deviation of each spot's position, per axis.
    scale_ppm : float
        Standard deviation of the print's scale.
    bow_um : float
        Standard deviation of the bow: height of the middle of the board over the middle of its sides.
    wedge_urad : float
        Standard deviation of the angle between the faces, per axis.
    ink_thickness_um : float
        Thickness of the ink; not drawn.
    scale_error_ppm : float
        Error of the print's scale besides the drawn one; not drawn.
    """

    print_sd_um: float = 0.6
    scale_ppm: float = 30.0
    bow_um: float = 2.0
    wedge_urad: float = 50.0
    ink_thickness_um: float = 1.0
    scale_error_ppm: float = 0.0


@dataclass(frozen=True, eq=False)
class PrintedBoard:
    """One board as it was made.

    Parameters
    ----------
    nominal : SpotBoard
        The drawing.
    centres : (rows * cols, 2) float64
        Printed centres in mm, in the board's frame, in the drawing's order.
    bow : float
        Height in mm of the middle of the board over the middle of its sides, positive towards the printed side.
    wedge : (2,) float64
        Gradient (d/dx, d/dy) of the board's thickness, in the board's frame.
    ink_thickness : float
        In mm.
    """

    nominal: SpotBoard
    centres: np.ndarray
    bow: float
    wedge: np.ndarray
    ink_thickness: float


def print_board(nominal: SpotBoard, errors: BoardErrors, rng: np.random.Generator) -> PrintedBoard:
    """Make one board after the drawing ``nominal``, with errors drawn from ``rng``.

    The numbers drawn do not depend on ``errors``: switching one error off leaves the others as they were. What the
    spots' errors have in common with a shift or a rotation of the board is taken out, since the board's frame is
    best-fitted to the printed spots.

    Raises
    ------
    InputError
        If the spots do not fit into their cells, or the cells not onto the board.
    """
    if nominal.size_mm < max(nominal.rows, nominal.cols) * nominal.pitch_mm:
        raise InputError(
            f"board.size_mm is {nominal.size_mm:g} mm, but {nominal.rows} x {nominal.cols} spots at a pitch of "
            f"{nominal.pitch_mm:g} mm need at least {max(nominal.rows, nominal.cols) * nominal.pitch_mm:g} mm; "
            "enlarge the board or reduce the pitch"
        )
    drawing = nominal.centres()
    scale, bow, wedge_x, wedge_y = rng.standard_normal(4)
    scatter = rng.standard_normal(drawing.shape)
    stretched = drawing * (1 + (scale * errors.scale_ppm + errors.scale_error_ppm) * 1e-6)
    scattered = stretched + scatter * errors.print_sd_um * 1e-3
    centres = _best_fitted(scattered, drawing)

    reach = np.linalg.norm(centres - drawing, axis=-1) + nominal.diameters() / 2
    if reach.max() >= nominal.pitch_mm / 2:
        raise InputError(
            f"a spot of the board reaches {reach.max():g} mm from its nominal centre, which must stay below half the "
            f"pitch, {nominal.pitch_mm / 2:g} mm; reduce the spots' diameters or the print errors"
        )
    return PrintedBoard(
        nominal=nominal,
        centres=centres,
        bow=bow * errors.bow_um * 1e-3,
        wedge=np.array([wedge_x, wedge_y]) * errors.wedge_urad * 1e-6,
        ink_thickness=errors.ink_thickness_um * 1e-3,
    )


def board(printed: PrintedBoard, face: Literal["printed", "blank"]) -> Specimen:
    """One face of a board, as a specimen in the frame that the module describes.

    ``as_built`` of the printed face holds ``centres_mm`` (rows * cols, 3), the printed centres on the ceramic.
    """
    nominal = {
        "pitch_mm": printed.nominal.pitch_mm,
        "big_diameter_mm": printed.nominal.big_diameter_mm,
        "small_diameter_mm": printed.nominal.small_diameter_mm,
        "size_mm": printed.nominal.size_mm,
    }
    if face == "blank":
        return Specimen("board-blank", (_blank_face(printed),), nominal)
    centres = np.column_stack([printed.centres, ceramic_height(printed, printed.centres)])
    return Specimen("board-printed", (_spots(printed), _ink(printed)), nominal, {"centres_mm": centres})


def ceramic_height(printed: PrintedBoard, xy: np.ndarray) -> np.ndarray:
    """Height (...) in mm of the ceramic's printed face at ``xy`` (..., 2) in the board's frame.

    A paraboloid that falls by ``bow`` from the middle of the board to the middle of a side; its mean over the nominal
    spots is taken out. The spots being symmetric, their best plane is then z = 0.
    """
    curvature = -printed.bow / (printed.nominal.size_mm / 2) ** 2
    mean_square = np.mean(np.sum(printed.nominal.centres() ** 2, axis=-1))
    return curvature * (np.sum(xy**2, axis=-1) - mean_square)


def blank_height(printed: PrintedBoard, xy: np.ndarray) -> np.ndarray:
    """Height (...) in mm of the blank face at ``xy`` (..., 2), both in the frame of the board turned over about y.

    The bow of a bent plate is the opposite on its other side; x of the wedge is mirrored.
    """
    wedge = printed.wedge * [-1.0, 1.0]
    return xy @ wedge - ceramic_height(printed, xy)


def _best_fitted(points: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """``points`` (n, 2), shifted and rotated for the least squared distance to ``reference`` (n, 2)."""
    p, r = points - points.mean(axis=0), reference - reference.mean(axis=0)
    angle = np.arctan2(np.sum(p[:, 0] * r[:, 1] - p[:, 1] * r[:, 0]), np.sum(p * r))
    c, s = np.cos(angle), np.sin(angle)
    return p @ np.array([[c, s], [-s, c]]) + reference.mean(axis=0)


def _spots(printed: PrintedBoard) -> Part:
    """The ceramic discs."""
    circles = _circles(printed)
    count, radii = circles.shape[1], printed.nominal.diameters() / 2
    rings, points = [circles], count
    while points > _FAN and points % 2 == 0:
        points //= 2
        share = 1 - 8 * (1 / points - 1 / count)  # triangles as high as they are wide, about
        rings.append(printed.centres[:, None] + (share * radii)[:, None, None] * _directions(points))
    rings.append(printed.centres[:, None])
    rings.reverse()
    corners = np.concatenate(rings, axis=1)[:, ring_faces([ring.shape[1] for ring in rings])]
    return _draped(corners.reshape(-1, 3, 2), lambda xy: ceramic_height(printed, xy), "ceramic")


def _ink(printed: PrintedBoard) -> Part:
    """The ink around the spots and its walls."""

    def height(xy: np.ndarray) -> np.ndarray:
        return ceramic_height(printed, xy) + printed.ink_thickness

    circles = _circles(printed)
    top = _draped(np.concatenate([_cells(printed, circles), _margin(printed)]), height, "ink")
    if printed.ink_thickness == 0:
        return top

    # Walls stand on the circles and face the discs' centres.
    xy = circles.reshape(-1, 2)
    n = len(xy)
    upper = np.column_stack([xy, height(xy)])
    lower = np.column_stack([xy, ceramic_height(printed, xy)])
    here = np.arange(n)
    after = np.roll(here.reshape(circles.shape[:2]), -1, axis=1).ravel()
    walls = np.concatenate([np.stack([here, after, after + n], -1), np.stack([here, after + n, here + n], -1)])
    vertices = np.concatenate([top.vertices, upper, lower])
    faces = np.concatenate([top.faces, walls.astype(np.int32) + np.int32(len(top.vertices))])
    return Part(vertices, faces, None, "ink")


def _circles(printed: PrintedBoard) -> np.ndarray:
    """Points (spots, points, 2) on the spots' circles, as many on each."""
    radii = printed.nominal.diameters() / 2
    # A multiple of 16 can be halved as often as there are rings around a spot.
    count = 16 * int(np.ceil(np.pi / np.sqrt(2 * _SPOT_SAGITTA_MM / radii.max()) / 16))
    return _snapped(printed.centres[:, None] + radii[:, None, None] * _directions(count))


def _cells(printed: PrintedBoard, circles: np.ndarray) -> np.ndarray:
    """Triangles (m, 3, 2) between each spot's circle and the border of its cell, a square around the nominal centre."""
    count = circles.shape[1]
    nominal, half = printed.nominal, printed.nominal.pitch_mm / 2
    offset = np.linalg.norm(printed.centres - nominal.centres(), axis=-1)
    radii = nominal.diameters() / 2
    way = half - offset - radii  # the shortest from the circle to the border
    rings = [circles]
    for k, share in enumerate(_RINGS):
        unit = _directions(count // 2 ** (k + 1))
        rings.append(printed.centres[:, None] + (radii + share * way)[:, None, None] * unit)
    border = _directions(8 * _BORDER)
    border = border / np.abs(border).max(axis=-1, keepdims=True) * half
    rings.append(nominal.centres()[:, None] + border)
    points = np.concatenate(rings, axis=1)  # (spots, points, 2)
    return points[:, ring_faces([ring.shape[1] for ring in rings])].reshape(-1, 3, 2)


def _directions(count: int) -> np.ndarray:
    """Unit vectors (count, 2), evenly spread, the first along x."""
    angle = 2 * np.pi * np.arange(count) / count
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def _margin(printed: PrintedBoard) -> np.ndarray:
    """Triangles (m, 3, 2) from the outermost cells to the edge of the board.

    A grid through the border points of the cells, without its middle.
    """
    nominal = printed.nominal
    along = np.tan(np.pi / 4 * np.arange(-_BORDER, _BORDER + 1) / _BORDER) * nominal.pitch_mm / 2
    lines = []
    for spots in (nominal.cols, nominal.rows):
        centres = (np.arange(spots) - (spots - 1) / 2) * nominal.pitch_mm
        inside = np.concatenate([(centres[:, None] + along[:-1]).ravel(), [spots * nominal.pitch_mm / 2]])
        layers = int(np.ceil((nominal.size_mm / 2 - inside[-1]) / nominal.pitch_mm))
        outside = np.linspace(inside[-1], nominal.size_mm / 2, layers + 1)[1:]
        lines.append((-outside[::-1], inside, outside))
    x, y = (np.concatenate(line) for line in lines)
    triangles = grid_points(x, y)[grid_faces(len(y), len(x))]
    middle = np.abs(triangles.mean(axis=1)) < np.array([nominal.cols, nominal.rows]) * nominal.pitch_mm / 2
    return triangles[~middle.all(axis=-1)]


def _blank_face(printed: PrintedBoard) -> Part:
    """The reverse side: ceramic, a grid of cells no larger than the pitch."""
    nominal = printed.nominal
    ticks = np.linspace(-0.5, 0.5, int(np.ceil(nominal.size_mm / nominal.pitch_mm)) + 1) * nominal.size_mm
    xy = grid_points(ticks, ticks)
    vertices = np.column_stack([xy, blank_height(printed, xy)])
    return Part(vertices, grid_faces(len(ticks), len(ticks)), None, "ceramic")


def _draped(triangles: np.ndarray, height: Callable[[np.ndarray], np.ndarray], material: str) -> Part:
    """Triangles (m, 3, 2) laid over ``height``; corners that coincide become one vertex."""
    corners, faces = np.unique(_snapped(triangles.reshape(-1, 2)), axis=0, return_inverse=True)
    vertices = np.column_stack([corners, height(corners)])
    return Part(vertices, faces.reshape(-1, 3).astype(np.int32), None, material)


def _snapped(xy: np.ndarray) -> np.ndarray:
    """``xy`` on a grid of 1 pm: neighbours compute shared corners from different centres, equal but for rounding."""
    return np.round(xy, 9)
