"""The bundle's calibration: one smooth model of everything, the board's pitch and rigidity for a scale, no stage."""

from itertools import chain
from typing import Any

import numpy as np

from greenough.instrument.errors import InputError

from .bundle import Bundle, solve_bundle
from .bundle_data import BundleData, PlaneBlocks, block_averages
from .calibration import Calibration, Residuals
from .calibration_data import CalibrationData
from .calibration_uncertainty import uncertainty_of_model
from .instrument_model import InstrumentModel
from .phase_height import MIN_PLANES
from .pixel_maps import model_maps, plane_residuals

MIN_BLOCKS = 30
"""Blocks of the picture, 40 across, in which each plane must have a phase."""


def calibrate_by_bundle(data: CalibrationData) -> Calibration:
    """Fit camera, projector, spots, postures and planes together, and turn the model into maps of every pixel.

    z = 0 is the printed face in the flat posture as the spots' phases show it: the board need not be turned over
    exactly. The blank side at stage position 0 is one more plane. Pixels are valid where `MIN_PLANES` planes or more
    were seen; their relation is the model's, without any pattern of their own, and is given out for all heights from
    the lowest to the highest plane. Where a pixel at the rim of the board or of the light saw a few planes at one end
    alone, the model, which knows the other heights from other pixels, extrapolates over the rest of the depth.

    Raises
    ------
    InputError
        If a plane has too few phases, there are too few at spots, or no pixel can be calibrated.
    """
    blocks = tuple(block_averages(phase) for phase in chain([data.phase_at_zero], data.phases))
    _check(blocks)
    readings = np.concatenate([[0.0], data.readings_mm])
    observed = BundleData(*data.sharp_postures, blocks)
    bundle = solve_bundle(observed, data.camera, data.board, readings, data.path_drift_mm2)

    def surface(k: int, xy: np.ndarray) -> np.ndarray:
        return bundle.plane_height(k + 1, xy)

    heights = bundle.state.planes[1:, 0]
    instrument = bundle.state.instrument
    low, high = float(heights.min()), float(heights.max())
    rays, everywhere = model_maps(instrument, low, high)
    planes = plane_residuals(everywhere, rays, data.phases, surface)
    relation = everywhere.where(planes.count >= MIN_PLANES)
    if not relation.valid.any():
        raise InputError(
            f"no pixel has a valid phase in {MIN_PLANES} or more of the {len(data.phases)} planes: check that the "
            "board's blank side is lit by the projector and seen by the camera"
        )
    return data.calibration(
        "bundle",
        camera=instrument.camera.camera,
        camera_from_world=instrument.camera.camera_from_world,
        rays=rays,
        phase_height=relation,
        figures={
            **posture_figures(bundle),
            "block_noise_rad": float(bundle.noise[2]),
            **depth_figures(instrument, low, high),
            "planes": len(heights),
            "plane_residual_um": float(np.sqrt(np.nanmean(planes.blocks_um**2))),
            "stage_departure_um": 1e3 * float(np.std(heights - data.readings_mm)),
        },
        residuals=Residuals(
            centres_px=data.centres_px,
            spots_px=bundle.residuals_px,
            spot_phases_rad=bundle.residuals_rad,
            planes_um=planes.blocks_um,
            pixels_um=np.where(relation.valid, planes.pixels_um, np.nan),
        ),
        uncertainty=uncertainty_of_model(instrument, low, high, data.known, data.drift_share),
        instrument=instrument,
    )


def _check(planes: tuple[PlaneBlocks, ...]) -> None:
    for k, plane in enumerate(planes):
        if len(plane.phase_rad) < MIN_BLOCKS:
            which = "at stage position 0" if k == 0 else f"of plane {k - 1:02d}"
            raise InputError(
                f"the blank side {which} fills only {len(plane.phase_rad)} of the blocks to be averaged over, and "
                f"{MIN_BLOCKS} are needed: lay it into the light"
            )


def posture_figures(bundle: Bundle) -> dict[str, Any]:
    """What a bundle says about postures, spots and camera."""
    state = bundle.state
    rmse_u, rmse_v = np.sqrt(np.nanmean(bundle.residuals_px**2, axis=(0, 1)))
    return {
        "spots_used": int(np.isfinite(bundle.residuals_px).all(axis=-1).sum()),
        "spot_phases_used": int(np.isfinite(bundle.residuals_rad).sum()),
        "outliers": int(bundle.outliers.sum()),
        "reprojection_rmse_u_px": float(rmse_u),
        "reprojection_rmse_v_px": float(rmse_v),
        "skew_angle_deg": state.instrument.camera.camera.skew_angle_deg,
        "print_sd_um": 1e3 * float(np.sqrt(np.mean(state.print_mm**2))),
        "bow_um": 1e3 * float(np.ptp(bundle.board.bow_terms @ state.bow_mm)),
        "spot_noise_px": float(bundle.noise[0]),
        "spot_phase_noise_rad": float(bundle.noise[1]),
    }


def depth_figures(instrument: InstrumentModel, z_low_mm: float, z_high_mm: float) -> dict[str, float]:
    """The calibrated depth in the middle of the field, and how well its length is known."""
    covariance = instrument.point_covariance(np.array([[0.0, 0.0, z_low_mm], [0.0, 0.0, z_high_mm]]))
    across = covariance[5, 5] + covariance[2, 2] - 2 * covariance[2, 5]
    return {"depth_sd_um": 1e3 * float(np.sqrt(across)), "z_low_mm": z_low_mm, "z_high_mm": z_high_mm}
