"""The bundle's equations: residuals of one posture or one plane, and their derivatives by the unknowns."""

from dataclasses import dataclass

import numpy as np

from .bundle_data import BundleData
from .bundle_state import BoardShape, BundleState, Layout, quadratic
from .imaging_path import cross_matrices

CENTRES, SPOT_PHASES, BLOCKS = range(3)
"""Kinds of observations."""


@dataclass(frozen=True, eq=False)
class Rows:
    """Equations of one posture or plane, linearised.

    Parameters
    ----------
    residual : (n,)
        Measured minus modelled; NaN where nothing was measured.
    jacobian : (n, m)
        Derivatives of what is modelled by the unknowns in ``columns``.
    columns : (m,)
    """

    residual: np.ndarray
    jacobian: np.ndarray
    columns: np.ndarray


def posture_rows(state: BundleState, layout: Layout, board: BoardShape, data: BundleData, k: int) -> Rows:
    """Equations of one posture: u, v and phase of every spot, spot by spot.

    The centre of an imaged circle's ellipse is not the image of its centre: the difference comes from the pinhole. The
    phase was measured where the ellipse's centre was found; with its gradient g on the board it is compared where the
    spot's centre is imaged, Φ + g·(image - found). That makes it independent of the noise of the found centre, which
    at 0.3 rad per px would be larger than its own.
    """
    spots, pose = state.spots(board), state.world_from_board[k]
    rotation = pose[:3, :3]
    turned = spots @ rotation.T
    camera, projector = state.instrument.camera, state.instrument.projector
    pixel, pixel_by_point, pixel_by_camera = camera.linearise(turned + pose[:3, 3])
    phase, phase_by_point, phase_by_projector = projector.linearise(turned + pose[:3, 3])
    camera_from_board = camera.camera_from_world @ pose
    on_axis = spots @ camera_from_board[:3, :3].T + camera_from_board[:3, 3]
    ellipse = camera.camera.project_circles(spots, board.radii, camera_from_board) - camera.camera.project(on_axis)
    found, measured = data.spots[k], data.phases[k]
    residual = np.empty((len(spots), 3))
    residual[:, :2] = found.centres_px - pixel - ellipse
    to_image = pixel - found.centres_px
    residual[:, 2] = (
        measured.phase_rad + np.sum(measured.gradient_rad * to_image, axis=1) - phase - state.offsets_rad[k]
    )

    gradient = np.nan_to_num(measured.gradient_rad)[:, None]  # (spots, 1, 2)
    by_point = np.concatenate([pixel_by_point, phase_by_point[:, None] - gradient @ pixel_by_point], axis=1)
    own_columns = np.r_[layout.offsets.start + k, layout.posture(k)]
    jacobian = np.zeros((len(spots), 3, layout.shape.start + len(own_columns)))
    jacobian[:, :2, : camera.parameters] = pixel_by_camera
    jacobian[:, 2:, : camera.parameters] = -gradient @ pixel_by_camera
    jacobian[:, 2, camera.parameters : layout.instrument] = phase_by_projector
    each = np.arange(len(spots))
    for axis in range(2):
        jacobian[each, :, layout.print.start + 2 * each + axis] = by_point @ rotation[:, axis]
    jacobian[:, :, layout.bow] = (by_point @ rotation[:, 2])[..., None] * board.bow_terms[:, None]
    jacobian[:, 2, layout.shape.start] = 1.0
    if len(own_columns) > 1:
        jacobian[:, :, -6:-3] = by_point @ -cross_matrices(turned)
        jacobian[:, :, -3:] = by_point
    columns = np.r_[0 : layout.shape.start, own_columns].astype(int)
    return Rows(residual.ravel(), jacobian.reshape(3 * len(spots), -1), columns)


def plane_rows(state: BundleState, layout: Layout, board: BoardShape, data: BundleData, k: int) -> Rows:
    """Equations of one blank plane: the phase of every block, where its pixel's ray meets the plane."""
    blocks, instrument = data.planes[k], state.instrument
    xyz = instrument.points(blocks.pixels, lambda xy: state.plane_height(k, board, xy))
    _, pixel_by_point, pixel_by_camera = instrument.camera.linearise(xyz)
    phase, phase_by_point, phase_by_projector = instrument.projector.linearise(xyz)
    # The point keeps to its pixel and to the plane: three equations say how it moves, and the phase with it.
    held = np.zeros((len(xyz), 3, 3))
    held[:, :2] = pixel_by_point
    held[:, 2, :2], held[:, 2, 2] = -state.plane_slopes(k, board, xyz[:, :2]), 1.0
    lever = np.linalg.solve(held.swapaxes(1, 2), phase_by_point[..., None])[..., 0]  # (n, 3)
    by_camera = -np.einsum("nk,nkp->np", lever[:, :2], pixel_by_camera)
    by_shape = lever[:, 2:] * quadratic(xyz[:, :2] / board.scale_mm)
    by_plane = lever[:, 2:] * np.column_stack([np.ones(len(xyz)), xyz[:, :2]])
    jacobian = np.concatenate([by_camera, phase_by_projector, by_shape, by_plane], axis=1)
    return Rows(blocks.phase_rad - phase, jacobian, np.r_[0 : layout.instrument, layout.shape, layout.plane(k)])
