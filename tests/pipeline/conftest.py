"""Pictures of a spot board made by casting rays, independent of the pipeline's camera model and of the twin."""

from collections.abc import Callable
from dataclasses import dataclass, field

import cv2
import numpy as np
import pytest

from greenough.instrument.contract import SpotBoard

SUPERSAMPLING = 4
WHITE_DN = 110.0
INK = 0.1

# fx, fy, skew, cx, cy, k1, k2, p1, p2: near the paper's Table 2, with distortion of some tenths of a pixel.
INTRINSICS = (22683.0, 22700.0, -1.0, 645.0, 470.0, -1.0, 0.0, -0.004, 0.003)


@dataclass(frozen=True)
class PaintedBoard:
    """One posture as it was made."""

    picture: np.ndarray  # (rows, cols) DN above black
    camera_from_board: np.ndarray  # (4, 4)
    ellipse_centres: np.ndarray  # (n, 2) px, of the imaged circles: what a detector should find
    lit_share: np.ndarray = field(repr=False)  # (n,) light on each spot's centre, 1 in the middle of the field


def rotation(axis: np.ndarray, angle: float) -> np.ndarray:
    """Rotation matrix by OpenCV, which the pipeline's own algebra does not use for this."""
    return cv2.Rodrigues(np.asarray(axis, float) / np.linalg.norm(axis) * angle)[0]


def pose(tilt_deg: float, towards_deg: float, turn_deg: float, shift: tuple[float, float]) -> np.ndarray:
    """camera_from_board of a board turned in its plane, then tilted about an axis in the table, then shifted."""
    axis = [np.cos(np.radians(towards_deg)), np.sin(np.radians(towards_deg)), 0.0]
    table_from_board = rotation(np.array(axis), np.radians(tilt_deg)) @ rotation(np.array([0, 0, 1.0]), np.radians(turn_deg))
    look = rotation(np.array([0.0, 1.0, 0.0]), np.radians(6.0)) @ np.diag([1.0, -1.0, -1.0])  # 6° off the normal
    transform = np.eye(4)
    transform[:3, :3] = look @ table_from_board
    transform[:3, 3] = look @ [*shift, 0.0] + [0.0, 0.0, 224.56]
    return transform


def draw_poses(rng: np.random.Generator, count: int = 16) -> list[np.ndarray]:
    """Postures as the procedure has them, the flat one last: tilt 5-25°, quarter turns, shifts ±1.2 and ±0.7 mm."""
    poses = []
    for k in range(count - 1):
        turn = 90.0 * (k % 4) + rng.uniform(-20, 20)
        towards = 360.0 * k / (count - 1) + rng.uniform(-10, 10)
        shift = (rng.uniform(-1.2, 1.2), rng.uniform(-0.7, 0.7))
        poses.append(pose(rng.uniform(5, 25), towards, turn, shift))
    return [*poses, pose(0.0, 0.0, 0.0, (0.0, 0.0))]


def distort(xy: np.ndarray, intrinsics: tuple[float, ...]) -> np.ndarray:
    """Pixels (..., 2) of ideal normalised coordinates: OpenCV's projection, with the skew added by hand."""
    fx, fy, skew, cx, cy, k1, k2, p1, p2 = intrinsics
    flat = xy.reshape(-1, 2)
    ideal, _ = cv2.projectPoints(
        np.column_stack([flat, np.ones(len(flat))]), np.zeros(3), np.zeros(3), np.eye(3), np.array([k1, k2, p1, p2])
    )
    x, y = ideal[:, 0].T
    return np.stack([fx * x + skew * y + cx, fy * y + cy], axis=-1).reshape(xy.shape)


def undistort(uv: np.ndarray, intrinsics: tuple[float, ...]) -> np.ndarray:
    """Ideal normalised coordinates of pixels, by fixed-point iteration on :func:`distort`."""
    fx, fy, skew, cx, cy = intrinsics[:5]
    scale = np.array([[1 / fx, -skew / (fx * fy)], [0.0, 1 / fy]])
    xy = (uv - [cx, cy]) @ scale.T
    for _ in range(4):
        xy = xy + (uv - distort(xy, intrinsics)) @ scale.T
    return xy


def ellipse_centres(centres: np.ndarray, radii: np.ndarray, camera_from_board: np.ndarray, intrinsics) -> np.ndarray:
    """Centres of the imaged circles (n, 2) px: mean of the polygon that 256 points on each circle are imaged to."""
    angle = np.arange(256) * 2 * np.pi / 256
    rim = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=-1) * radii[:, None, None]
    rim[..., :2] += centres[:, None, :2]
    xyz = rim @ camera_from_board[:3, :3].T + camera_from_board[:3, 3]
    u, v = np.moveaxis(distort(xyz[..., :2] / xyz[..., 2:], intrinsics), -1, 0)
    result = []
    for k in range(len(centres)):
        conic = np.linalg.lstsq(_conic_terms(u[k] - u[k].mean(), v[k] - v[k].mean()), np.ones(256), rcond=None)[0]
        a, b, c, d, e = conic
        result.append(np.linalg.solve([[2 * a, b], [b, 2 * c]], [-d, -e]) + [u[k].mean(), v[k].mean()])
    return np.array(result)


def _conic_terms(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return np.stack([x * x, x * y, y * y, x, y], axis=-1)


def paint_board(
    board: SpotBoard,
    camera_from_board: np.ndarray,
    rng: np.random.Generator,
    *,
    shape: tuple[int, int] = (960, 1280),
    intrinsics: tuple[float, ...] = INTRINSICS,
    centres: np.ndarray | None = None,
    blur_px: float = 1.3,
    noise_dn: float = 2.0,
    gradient: tuple[float, float] = (0.0, 0.0),
    lit_field: bool = True,
) -> PaintedBoard:
    """One picture: each sub-pixel's ray meets the board's plane, light times reflectance is blurred, noise added.

    ``gradient`` is the light's relative change per px, exponential, so that it is the same everywhere. The lit field is
    10.84 x 6.1 mm with a soft edge and falls off by a third towards its corners; beyond it there is no light.
    """
    printed = board.centres() if centres is None else centres
    radii = board.diameters() / 2
    truth = ellipse_centres(printed, radii, camera_from_board, intrinsics)
    s = SUPERSAMPLING
    rows, cols = shape
    reflectance = np.full((rows * s, cols * s), INK, dtype=np.float32)
    px_per_mm = intrinsics[0] / camera_from_board[2, 3]
    normal, origin = camera_from_board[:3, 2], camera_from_board[:3, 3]
    for centre, radius, (u, v) in zip(printed, radii, truth, strict=True):
        half = int(np.ceil(radius * px_per_mm)) + 2
        left, right = max(0, int(u) - half), min(cols, int(u) + half + 2)
        top, bottom = max(0, int(v) - half), min(rows, int(v) + half + 2)
        if left >= right or top >= bottom:
            continue
        grid_u, grid_v = np.meshgrid(
            (np.arange(left * s, right * s) + 0.5) / s - 0.5, (np.arange(top * s, bottom * s) + 0.5) / s - 0.5
        )
        ray = undistort(np.stack([grid_u, grid_v], axis=-1), intrinsics)
        ray = np.concatenate([ray, np.ones_like(ray[..., :1])], axis=-1)
        hit = ray * ((normal @ origin) / (ray @ normal))[..., None] - origin
        offset = hit @ camera_from_board[:3, :2] - centre
        # Signed distance over its own gradient per sub-pixel: the share of the sub-pixel inside the circle.
        distance = np.hypot(offset[..., 0], offset[..., 1]) - radius
        steepness = np.hypot(*np.gradient(distance))
        covered = np.clip(0.5 - distance / np.maximum(steepness, 1e-9), 0.0, 1.0)
        window = reflectance[top * s : bottom * s, left * s : right * s]
        window += ((1.0 - INK) * covered).astype(np.float32)

    sub_v, sub_u = ((np.arange(n * s) + 0.5) / s - 0.5 for n in shape)
    middle_u, middle_v = intrinsics[3:5]
    light_u, light_v = np.exp(gradient[0] * (sub_u - middle_u)), np.exp(gradient[1] * (sub_v - middle_v))
    light = WHITE_DN * np.outer(light_v, light_u)
    share = np.ones(len(truth))
    if lit_field:
        field_u, field_v = _field(sub_u - middle_u, 10.84 * 101 / 2), _field(sub_v - middle_v, 6.1 * 101 / 2)
        light *= np.outer(field_v, field_u)
        share = _field(truth[:, 0] - middle_u, 10.84 * 101 / 2) * _field(truth[:, 1] - middle_v, 6.1 * 101 / 2)
    fine = cv2.GaussianBlur((light * reflectance).astype(np.float32), (0, 0), blur_px * s)
    picture = fine.reshape(rows, s, cols, s).mean(axis=(1, 3)) + rng.normal(0.0, noise_dn, shape)
    return PaintedBoard(picture, camera_from_board, truth, share)


def _field(offset: np.ndarray, half: float) -> np.ndarray:
    """Light along one axis: falls off by a sixth to the edge, then to nothing within some 6 px."""
    return (1.0 - (offset / half) ** 2 / 6.0).clip(0.0) / (1.0 + np.exp((np.abs(offset) - half) / 1.5))


@pytest.fixture(scope="session")
def spot_board() -> SpotBoard:
    """The paper's board (Fig. 7)."""
    return SpotBoard(9, 11, 0.65, 0.4, 0.175, 8.0, ((4, 5), (4, 6), (3, 5), (4, 3), (6, 5)))


@pytest.fixture(scope="session")
def paint() -> Callable[..., PaintedBoard]:
    return paint_board


@pytest.fixture(scope="session")
def poses() -> Callable[..., list[np.ndarray]]:
    return draw_poses
