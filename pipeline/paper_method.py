"""The paper's calibration: the board at its drawing's word, the stage at its readings, a relation for every pixel."""

import numpy as np
from numpy.polynomial import chebyshev

from greenough.instrument.errors import InputError

from .calibration import Calibration, Residuals
from .calibration_data import CalibrationData
from .calibration_uncertainty import CalibrationUncertainty, essential, frame_drift, grid_nodes
from .phase_height import COEFFICIENTS, PhaseHeightFit, PlanePhases, fit_phase_height
from .pixel_maps import PlaneResiduals, plane_residuals
from .rays import points_at_height, rays_of_camera

_VOLUME_MM = (4.0, 3.0)  # half of the paper's 8 x 6 mm


def calibrate_by_paper(data: CalibrationData) -> Calibration:
    """Section 3 of the paper: eq. 20-22 for the camera, eq. 11-19 for every pixel.

    The flat posture gives the world frame, the stage's readings give the heights, and the blank side in the flat
    posture's place is z = 0 of both.

    Raises
    ------
    InputError
        If the planes do not determine the relation, or share no pixel with the blank side at stage position 0.
    """
    camera = data.camera
    fit, heights = fit_planes(data.phase_at_zero, data.phases, data.readings_mm)
    rays = rays_of_camera(camera.camera, camera.camera_from_world)
    planes = plane_residuals(fit.relation, rays, data.phases, lambda k, xy: np.full(len(xy), heights[k]))
    rmse_u, rmse_v = camera.reprojection_rmse_px
    corners = np.array([[x, y, z] for x in (-1, 0, 1) for y in (-1, 0, 1) for z in data.readings_mm[[0, -1]]])
    corners[:, :2] *= _VOLUME_MM
    variances = np.linalg.eigvalsh(camera.projected_covariance(corners))
    return data.calibration(
        "paper",
        camera=camera.camera,
        camera_from_world=camera.camera_from_world,
        rays=rays,
        phase_height=fit.relation,
        figures={
            "spots_used": int(np.isfinite(camera.residuals_px).all(axis=-1).sum()),
            "reprojection_rmse_u_px": float(rmse_u),
            "reprojection_rmse_v_px": float(rmse_v),
            "skew_angle_deg": camera.camera.skew_angle_deg,
            "print_sd_um": 1e3 * float(camera.print_sd_mm),
            "spot_noise_px": float(camera.noise_sd_px),
            "projection_sd_in_volume_px": float(np.sqrt(variances.max())),
            "planes": len(data.readings_mm),
            "z_low_mm": float(data.readings_mm.min()),
            "z_high_mm": float(data.readings_mm.max()),
            "phase_height_condition": fit.condition,
            "phase_height_residual_um": float(np.nanmedian(fit.residual_um)),
            "plane_residual_um": float(np.sqrt(np.mean(fit.plane_residual_um**2))),
        },
        residuals=Residuals(
            centres_px=data.centres_px,
            spots_px=camera.residuals_px,
            spot_phases_rad=np.full(camera.residuals_px.shape[:2], np.nan),
            planes_um=planes.blocks_um,
            pixels_um=planes.pixels_um,
        ),
        uncertainty=_uncertainty(data, heights, fit.plane_residual_um, planes),
    )


def _uncertainty(
    data: CalibrationData, heights: np.ndarray, plane_residual_um: np.ndarray, planes: PlaneResiduals
) -> CalibrationUncertainty:
    """From what planes and spots leave over: the stage's errors, the pixels' noise, and the camera's.

    What the planes' residuals have in common over the pixels are the stage's errors, which give all pixels the same
    error of height, and take x and y along on the rays; z = 0, where the board's two sides meet, has none. Straightness
    and tilts of the stage, the shape of the blank face, and how far the paths had drifted until it was shown are seen
    by nobody and are not in it.
    """
    nodes, pixels, z = grid_nodes(data.camera.camera.shape, float(heights.min()), float(heights.max()))
    freedom = len(heights) - len(COEFFICIENTS)
    stage_sd = 1e-3 * np.sqrt(np.sum(plane_residual_um**2) / freedom)
    scatter, common = (np.nanmean(np.square(um, dtype=float)) for um in (planes.pixels_um, planes.blocks_um))
    pixel_sd = 1e-3 * np.sqrt(max(scatter - common, 0.0) * len(heights) / freedom)
    camera, pose = data.camera.camera, data.camera.camera_from_world
    points = points_at_height(pixels, z, camera, pose)
    along_ray = points_at_height(pixels, z + 1.0, camera, pose) - points  # by a unit of height
    lift = stage_sd * (fitted_errors(heights, z) - fitted_errors(heights, np.zeros(1)))
    stage = along_ray[:, :, None] * lift[:, None]
    steps = (np.array([1.0, 0.0]), np.array([0.0, 1.0]))
    by_pixel = np.stack([points_at_height(pixels + step, z, camera, pose) - points for step in steps], axis=-1)
    rays = -by_pixel @ data.camera.projected_errors(points)  # none along z, which the relation gives
    scale = (data.known.board_scale * points * [1.0, 1.0, 0.0])[..., None]
    drift = np.broadcast_to(frame_drift(data.known, data.drift_share), (len(z), 3, 3))
    displacements = np.concatenate([stage, rays, scale, drift], axis=-1)
    pattern = pixel_sd * np.linalg.norm(fitted_errors(heights, nodes[0]), axis=1)
    return CalibrationUncertainty(*nodes, essential(displacements), pattern)


def fitted_errors(heights: np.ndarray, z: np.ndarray) -> np.ndarray:
    """What planes at ``heights`` (planes,), each wrong by one on its own, do to heights z: (n, 4) independent causes.

    A pixel's relation has four effective parameters and errs as a cubic V c through the planes does, whose covariance
    is (VᵀV)⁻¹ = R⁻¹ R⁻ᵀ with V = Q R.
    """
    half_range = np.abs(heights).max()
    planes, here = (chebyshev.chebvander(at / half_range, len(COEFFICIENTS) - 1) for at in (heights, z))
    return here @ np.linalg.inv(np.linalg.qr(planes, mode="r"))


def fit_planes(
    phase_at_zero: np.ndarray, phases: PlanePhases, readings_mm: np.ndarray
) -> tuple[PhaseHeightFit, np.ndarray]:
    """Every pixel's relation, with the stage's readings taken for heights, and the heights of the planes.

    Readings err, and their fit need not pass through the posture that the board's two sides share: heights are counted
    from there.

    Parameters
    ----------
    phase_at_zero : (rows, cols)
        Absolute phase of the blank side where the flat board lay, rad, NaN where invalid.
    phases : (planes, rows, cols)
        The same at the planes.
    readings_mm : (planes,)
        The stage's.

    Raises
    ------
    InputError
        If the planes do not determine the relation, or share no pixel with the blank side at stage position 0.
    """
    zero = fit_phase_height(phases, readings_mm).relation.height(phase_at_zero)
    if not np.isfinite(zero).any():
        raise InputError("the blank side at stage position 0 shares no pixel with the planes: lay it into the light")
    heights = readings_mm - np.nanmean(zero)
    return fit_phase_height(phases, heights), heights
