"""What the homographies of a flat board tell by themselves: whether its postures differ, and a camera to start from."""

import cv2
import numpy as np

from greenough.instrument.errors import InputError

from .camera_model import CameraModel

_PARALLEL = 10.0  # tilts must differ by this many of their standard deviations (root mean square)
_LEAST_NOISE_PX = 1e-3  # keeps the weights finite where pictures are perfect
_LONGEST_FOCAL = 200.0  # in widths of the picture: a field of view of 0.3 degrees


def check_tilts(centres: np.ndarray, seen: np.ndarray, nominal: np.ndarray, names: list[str]) -> None:
    """Refuse postures that are all parallel: parallel planes share one vanishing line, whatever the camera.

    The vanishing line of each posture is taken from its homography, its uncertainty from the homography's residual;
    if the lines scatter by no more than a few of their standard deviations, nothing tells f from the distance.

    Parameters
    ----------
    centres : (postures, spots, 2)
        In px; anything where unseen.
    seen : (postures, spots) bool
    nominal : (spots, 2)
        On the board, mm.
    names : list of str
        Of the postures, for the message.

    Raises
    ------
    InputError
        If the postures are parallel.
    """
    lines, weights = [], []
    middle = centres[seen].mean(axis=0)
    for points, known in zip(centres, seen, strict=True):
        uv = points[known] - middle
        homography, _ = cv2.findHomography(nominal[known], uv)
        line = np.linalg.solve(homography.T, [0.0, 0.0, 1.0])
        lines.append(line[:2] / line[2])
        mapped = cv2.perspectiveTransform(nominal[known][:, None], homography)[:, 0]
        noise = max(np.sqrt(np.sum((uv - mapped) ** 2) / (uv.size - 8)), _LEAST_NOISE_PX)
        # A line shifted by d moves points by -uv (d·uv), of which an affine map takes over its share.
        affine = np.column_stack([np.ones(len(uv)), uv])
        design = np.block(
            [
                [affine, np.zeros_like(affine), uv[:, :1] * uv],
                [np.zeros_like(affine), affine, uv[:, 1:] * uv],
            ]
        )
        scale = np.linalg.norm(design, axis=0)
        inverse = np.linalg.inv((design / scale).T @ (design / scale))[6:, 6:]
        weights.append(np.linalg.inv(inverse) * np.outer(scale[6:], scale[6:]) / noise**2)
    lines, weights = np.array(lines), np.array(weights)
    mean = np.linalg.solve(weights.sum(axis=0), np.einsum("kij,kj->i", weights, lines))
    scatter = np.einsum("ki,kij,kj->", lines - mean, weights, lines - mean) / (2 * (len(lines) - 1))
    if scatter < _PARALLEL**2:
        raise InputError(
            f"all {len(lines)} postures of the board are parallel as far as the pictures tell ({', '.join(names)}): "
            "the camera cannot be calibrated; tilt the board by 5 to 25 degrees in different directions"
        )


def start_camera(
    centres: np.ndarray, seen: np.ndarray, nominal: np.ndarray, shape: tuple[int, int]
) -> tuple[CameraModel, np.ndarray]:
    """Zhang's closed form for a pinhole with square pixels and its principal point in the middle of the picture.

    The columns h1, h2 of a homography from the board are images of directions that are orthogonal and equally long:
    h1ᵀ ω h2 = 0 and h1ᵀ ω h1 = h2ᵀ ω h2 with ω = diag(1/f², 1/f², 1), two linear equations in 1/f² per posture.

    Parameters are those of `check_tilts`; ``shape`` is (rows, cols) of the picture.

    Returns
    -------
    camera : CameraModel
    camera_from_board : (postures, 4, 4)
    """
    middle = (np.array(shape[::-1]) - 1) / 2
    homographies = np.array(
        [
            cv2.findHomography(nominal[known], points[known] - middle)[0]
            for points, known in zip(centres, seen, strict=True)
        ]
    )
    homographies /= np.linalg.norm(homographies[:, :2, :1], axis=1, keepdims=True)
    h1, h2 = homographies[:, :, 0], homographies[:, :, 1]
    flat = np.concatenate([np.sum(h1[:, :2] * h2[:, :2], axis=1), np.sum(h1[:, :2] ** 2 - h2[:, :2] ** 2, axis=1)])
    deep = np.concatenate([h1[:, 2] * h2[:, 2], h1[:, 2] ** 2 - h2[:, 2] ** 2])
    focal = np.sqrt(max(-(flat @ flat) / (flat @ deep), 0.0))
    focal = float(np.clip(focal, 0.5 * max(shape), _LONGEST_FOCAL * max(shape)))
    camera = CameraModel(focal, focal, 0.0, middle[0], middle[1], 0.0, 0.0, 0.0, 0.0, shape)

    poses = np.tile(np.eye(4), (len(seen), 1, 1))
    for pose, homography in zip(poses, homographies, strict=True):
        columns = homography / [[focal], [focal], [1.0]]
        columns /= np.sqrt(np.linalg.norm(columns[:, 0]) * np.linalg.norm(columns[:, 1])) * np.sign(columns[2, 2])
        u, _, vt = np.linalg.svd(np.column_stack([columns[:, :2], np.cross(columns[:, 0], columns[:, 1])]))
        pose[:3, :3], pose[:3, 3] = u @ vt, columns[:, 2]
    return camera, poses
