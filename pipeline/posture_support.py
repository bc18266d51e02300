"""Where tilted postures support a model: at the heights at which spots with a phase were seen around a pixel.

A model that is fitted to postures alone is known where their spots were, in the picture and in height. Between them it
interpolates, and beyond them polynomials run away. So a pixel is calibrated over that part of its ray which lies within
the convex hull of all spots with a phase, as points (u, v, z). Every spot stands for half a pitch around it, as far as
to the middle between it and its neighbour.

As by every method, `reconstruct` gives points half a step of the planes beyond.

Over the middle of the field tilted boards support heights as far as their edges reach on either side, though no spot
may have been there: it lies between spots. Towards the rim of the field the hull is thinner.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from scipy.spatial import ConvexHull

from .bundle_method import depth_figures
from .calibration import Calibration, Method
from .calibration_data import CalibrationData
from .calibration_uncertainty import uncertainty_of_model
from .instrument_model import InstrumentModel
from .pixel_maps import model_maps

_VERTICAL = 1e-9  # a face of the hull whose normal has no more along z bounds no height


def supported_calibration(
    method: Method,
    data: CalibrationData,
    instrument: InstrumentModel,
    z_mm: np.ndarray,
    residuals_px: np.ndarray,
    residuals_rad: np.ndarray,
    figures: Mapping[str, Any],
) -> Calibration:
    """The calibration of a model that was fitted to postures, valid where these support it.

    Parameters
    ----------
    method : Method
    data : CalibrationData
    instrument : InstrumentModel
    z_mm : (postures, spots)
        Heights of all spots.
    residuals_px : (postures, spots, 2)
    residuals_rad : (postures, spots)
        Of the spots' phases; NaN where one was not measured or left out: such spots support nothing.
    figures : mapping
        The method's own.
    """
    used = np.isfinite(residuals_rad)
    _, slope, _ = instrument.camera.linearise(np.zeros((1, 3)))
    reach = data.board.pitch_mm / 2
    reach_px = reach * float(np.sqrt(abs(np.linalg.det(slope[0, :, :2]))))
    places = np.column_stack([data.centres_px[used], z_mm[used]])
    z_range = supported_heights(instrument.camera.camera.shape, places, np.array([reach_px, reach_px, reach]))
    low, high = float(np.nanmin(z_range)), float(np.nanmax(z_range))
    rays, everywhere = model_maps(instrument, low, high)
    return data.calibration(
        method,
        camera=instrument.camera.camera,
        camera_from_world=instrument.camera.camera_from_world,
        rays=rays,
        phase_height=everywhere.within(z_range, np.isfinite(z_range[..., 0])),
        figures={**figures, **depth_figures(instrument, float(z_mm[used].min()), float(z_mm[used].max()))},
        residuals=data.posture_residuals(residuals_px, residuals_rad),
        uncertainty=uncertainty_of_model(instrument, low, high, data.known, data.drift_share),
        instrument=instrument,
    )


def supported_heights(shape: tuple[int, int], places: np.ndarray, reach: np.ndarray) -> np.ndarray:
    """Lowest and highest height (rows, cols, 2) on each pixel's line of sight within the hull; NaN where it passes by.

    Parameters
    ----------
    shape : (rows, cols)
    places : (n, 3)
        u, v and z, not all in one plane.
    reach : (3,)
        How far along u, v and z each place stands for its surroundings: the hull is that of all places moved by this
        either way along each axis.
    """
    moves = np.concatenate([np.eye(3), -np.eye(3)])
    hull = ConvexHull((places[:, None] / reach + moves).reshape(-1, 3))  # in units in which all axes are alike
    rows, cols = shape
    u, v = np.arange(cols) / reach[0], np.arange(rows)[:, None] / reach[1]
    low, high = np.full(shape, -np.inf), np.full(shape, np.inf)
    for along_u, along_v, along_z, offset in np.unique(hull.equations.round(9), axis=0):  # inside, all are <= 0
        rest = along_u * u + (along_v * v + offset)
        if along_z > _VERTICAL:
            np.minimum(high, -rest / along_z, out=high)
        elif along_z < -_VERTICAL:
            np.maximum(low, -rest / along_z, out=low)
        else:
            high[rest > 0] = -np.inf
    inside = high > low
    return np.where(inside[..., None], reach[2] * np.stack([low, high], axis=-1), np.nan)
