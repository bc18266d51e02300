"""Pictures of a spot board made by casting rays, independent of the pipeline's camera model and of the twin.

And the camera's blur summed up in space on a fine grid: a code path of its own, without transfer functions.
"""

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
import pytest
from scipy.signal import fftconvolve
from scipy.special import j1

from greenough.instrument.contract import SpotBoard

SUPERSAMPLING = 3
WHITE_DN = 110.0
LIT_PX = (10.84 * 101, 6.1 * 101)  # the lit field's width and height
INK = 0.1
BLUR_REACH_PX = 40

# fx, fy, skew, cx, cy, k1, k2, p1, p2: near the paper's Table 2, with distortion of some tenths of a pixel.
INTRINSICS = (22683.0, 22700.0, -1.0, 645.0, 470.0, -1.0, 0.0, -0.004, 0.003)


@dataclass(frozen=True)
class PaintedBoard:
    """One posture as it was made."""

    picture: np.ndarray  # (rows, cols) DN above black
    camera_from_board: np.ndarray  # (4, 4)
    ellipse_centres: np.ndarray  # (n, 2) px, of the imaged circles: what a detector should find


def rotation(axis: np.ndarray, angle: float) -> np.ndarray:
    """Rotation matrix by OpenCV, which the pipeline's own algebra does not use for this."""
    return cv2.Rodrigues(np.asarray(axis, float) / np.linalg.norm(axis) * angle)[0]


def make_pose(tilt_deg: float, towards_deg: float, turn_deg: float, shift: tuple[float, float]) -> np.ndarray:
    """camera_from_board of a board turned in its plane, then tilted about an axis in the table, then shifted."""
    axis = [np.cos(np.radians(towards_deg)), np.sin(np.radians(towards_deg)), 0.0]
    table_from_board = rotation(np.array(axis), np.radians(tilt_deg)) @ rotation(
        np.array([0, 0, 1.0]), np.radians(turn_deg)
    )
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
        poses.append(make_pose(rng.uniform(5, 25), towards, turn, shift))
    return [*poses, make_pose(0.0, 0.0, 0.0, (0.0, 0.0))]


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


def ellipse_centres(
    centres: np.ndarray, radii: np.ndarray, camera_from_board: np.ndarray, intrinsics: tuple[float, ...] = INTRINSICS
) -> np.ndarray:
    """Centres (n, 2) px of the imaged circles: of the conics fitted to what 64 points on each circle are imaged to."""
    angle = np.arange(64) * 2 * np.pi / 64
    rim = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=-1) * radii[:, None, None]
    rim[..., :2] += centres[:, None, :2]
    uv = image_points(rim, camera_from_board, intrinsics)
    middle = uv.mean(axis=1)
    size = np.ptp(uv, axis=(1, 2))[:, None]
    x, y = np.moveaxis((uv - middle[:, None]) / size[..., None], -1, 0)
    terms = np.stack([x * x, x * y, y * y, x, y], axis=-1)  # (n, 64, 5), to sum to 1
    across = terms.swapaxes(1, 2)
    a, b, c, d, e = np.linalg.solve(across @ terms, across.sum(axis=2)[..., None])[..., 0].T
    det = 4 * a * c - b * b
    return middle + size * np.stack([(b * e - 2 * c * d) / det, (b * d - 2 * a * e) / det], axis=-1)


def image_points(
    points: np.ndarray, camera_from_frame: np.ndarray, intrinsics: tuple[float, ...] = INTRINSICS
) -> np.ndarray:
    """Pixels (..., 2) of points (..., 3)."""
    xyz = points @ camera_from_frame[:3, :3].T + camera_from_frame[:3, 3]
    return distort(xyz[..., :2] / xyz[..., 2:], intrinsics)


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
    px_per_mm = intrinsics[0] / camera_from_board[2, 3]
    normal, origin = camera_from_board[:3, 2], camera_from_board[:3, 3]

    def light(u: np.ndarray, v: np.ndarray) -> np.ndarray:
        across, down = np.exp(gradient[0] * (u - intrinsics[3])), np.exp(gradient[1] * (v - intrinsics[4]))
        if lit_field:
            across, down = (
                across * _field(u - intrinsics[3], LIT_PX[0] / 2),
                down * _field(v - intrinsics[4], LIT_PX[1] / 2),
            )
        return WHITE_DN * np.outer(down, across)

    # Only the part with spots is painted finely; the rest is ink.
    rows, cols = shape
    s = SUPERSAMPLING
    left, top = np.maximum(0, truth.min(axis=0).astype(int) - 40)
    right, bottom = np.minimum([cols, rows], truth.max(axis=0).astype(int) + 40)
    fine_u, fine_v = _sub_pixels(left, right), _sub_pixels(top, bottom)
    reflectance = np.full((len(fine_v), len(fine_u)), INK)
    for centre, radius, (u, v) in zip(printed, radii, truth, strict=True):
        half = radius * px_per_mm + 2
        inside_u, inside_v = np.abs(fine_u - u) < half, np.abs(fine_v - v) < half
        if not (inside_u.any() and inside_v.any()):
            continue
        ray = undistort(np.stack(np.meshgrid(fine_u[inside_u], fine_v[inside_v]), axis=-1), intrinsics)
        ray = np.concatenate([ray, np.ones_like(ray[..., :1])], axis=-1)
        hit = ray * ((normal @ origin) / (ray @ normal))[..., None] - origin
        offset = hit @ camera_from_board[:3, :2] - centre
        # Signed distance over its own change from sub-pixel to sub-pixel: the share inside the circle.
        distance = np.hypot(offset[..., 0], offset[..., 1]) - radius
        steepness = np.hypot(*np.gradient(distance)) if min(distance.shape) > 1 else np.ones_like(distance)
        reflectance[np.ix_(inside_v, inside_u)] += (1.0 - INK) * np.clip(0.5 - distance / steepness, 0.0, 1.0)
    fine = cv2.GaussianBlur((light(fine_u, fine_v) * reflectance).astype(np.float32), (0, 0), blur_px * s)
    picture = INK * light(np.arange(cols), np.arange(rows))
    picture[top:bottom, left:right] = fine.reshape(bottom - top, s, right - left, s).mean(axis=(1, 3))
    return PaintedBoard(picture + rng.normal(0.0, noise_dn, shape), camera_from_board, truth)


def _sub_pixels(first: int, last: int) -> np.ndarray:
    """Centres of the sub-pixels of pixels first to last - 1; a pixel's own centre is at its integer."""
    return (np.arange(first * SUPERSAMPLING, last * SUPERSAMPLING) + 0.5) / SUPERSAMPLING - 0.5


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


@pytest.fixture(scope="session")
def pose() -> Callable[..., np.ndarray]:
    return make_pose


@pytest.fixture(scope="session")
def imaged_circles() -> Callable[..., np.ndarray]:
    return ellipse_centres


@pytest.fixture(scope="session")
def imaged_points() -> Callable[..., np.ndarray]:
    return image_points


def blur_in_space(light: np.ndarray, fine: int, cutoff_per_px: float, disc_radius_px: float) -> np.ndarray:
    """What square pixels see of light on ``fine`` x ``fine`` sub-pixels each, real or complex, behind a lens.

    The Airy pattern (2 J1(x) / x)², x = π cut-off r, has volume 1 over the whole plane; the disc of defocus is evenly
    filled, its rim smoothed over one sub-pixel.
    """
    n = np.arange(-BLUR_REACH_PX * fine, BLUR_REACH_PX * fine + 1) / fine
    distance = np.hypot(n, n[:, None])
    x = np.maximum(np.pi * cutoff_per_px * distance, 1e-9)
    light = fftconvolve(light, np.pi / 4 * (cutoff_per_px / fine) ** 2 * (2 * j1(x) / x) ** 2, mode="same")
    if disc_radius_px > 0:
        near = np.abs(n) <= disc_radius_px + 1
        disc = np.clip((disc_radius_px - distance[np.ix_(near, near)]) * fine + 0.5, 0, 1)
        light = fftconvolve(light, disc / disc.sum(), mode="same")
    rows, cols = light.shape
    return light.reshape(rows // fine, fine, cols // fine, fine).mean(axis=(1, 3))


@pytest.fixture(scope="session")
def blurred() -> Callable[..., np.ndarray]:
    return blur_in_space
