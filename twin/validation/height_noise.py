"""The noise of a height, predicted from the sizes of the twin's effects without its random numbers.

The phase is that of a least squares fit of A + B cos(Φ + 2π n / N) to the N grey values of the densest fringes, each
weighted by the inverse of the variance that the camera's data sheet gives it. Small errors δ of the grey values move it
by Σ c_n δ_n, and with the c_n any noise of the frames is known in the phase.
"""

import numpy as np

from greenough.pipeline.decode import PhaseMap
from greenough.pipeline.grey_variance import QUANTISATION_VARIANCE, GreyVariance, camera_variance

from .setup import Setup

_PIXELS = 4000  # that stand for the picture


def predicted_noise(setup: Setup, phase_map: PhaseMap, quantised: bool) -> float:
    """Standard deviation of a height over the picture, mm, by the noise of one exposure.

    Counted are shot noise, read noise, quantisation, flicker and vibration, as far as they are on. Flicker and
    vibration disturb all pixels of a frame together: what they move the whole plane by is not noise, and left out.

    Parameters
    ----------
    setup : Setup
        A calibrated twin.
    phase_map : PhaseMap
        Of one exposure: how bright it is, how much contrast it has, and its phase.
    quantised : bool
        Whether the camera's grey values are whole numbers.
    """
    settings, camera = setup.bench.settings, setup.rig.camera.noise
    sigma = setup.height_sigma(phase_map)
    chosen = np.flatnonzero(np.isfinite(sigma))
    chosen = chosen[:: max(1, len(chosen) // _PIXELS)]
    background, modulation, phase = (
        image.ravel()[chosen].astype(np.float64)
        for image in (phase_map.background, phase_map.modulation, phase_map.absolute)
    )
    mm_per_rad = sigma.ravel()[chosen] / phase_map.sigma.ravel()[chosen]
    steps = setup.rig.procedure.steps[-1]
    angle = phase[:, None] + 2 * np.pi * np.arange(steps) / steps
    grey = background[:, None] + modulation[:, None] * np.cos(angle)
    by_grey = mm_per_rad[:, None] * phase_shares(modulation, angle, camera_variance(camera, quantised).at(grey))
    true = GreyVariance(
        (settings.camera.read_noise_e / camera.electrons_per_dn) ** 2 + quantised * QUANTISATION_VARIANCE,
        settings.camera.shot_noise / camera.electrons_per_dn,
    )
    by_flicker = by_grey * grey  # of each frame
    by_raising = -by_grey * modulation[:, None] * np.sin(angle) / mm_per_rad[:, None]
    stability = settings.stability
    square = np.mean(np.sum(by_grey**2 * true.at(grey), axis=1))
    square += stability.flicker**2 * np.sum(np.var(by_flicker, axis=0))
    square += (1e-3 * stability.vibration_um) ** 2 * np.sum(np.var(by_raising, axis=0))
    return float(np.sqrt(square))


def phase_shares(modulation: np.ndarray, angle: np.ndarray, variance: np.ndarray) -> np.ndarray:
    """How much the fitted phase changes with each grey value, (pixels, steps) rad/DN.

    Parameters
    ----------
    modulation : (pixels,)
        B in DN.
    angle : (pixels, steps)
        Φ + 2π n / N.
    variance : (pixels, steps)
        By whose inverse the grey values are weighted, DN².
    """
    # Columns of the design: background, modulation, phase.
    design = np.stack([np.ones_like(angle), np.cos(angle), -modulation[:, None] * np.sin(angle)], axis=-1)
    weighted = design / variance[..., None]
    normal = np.einsum("pni,pnj->pij", design, weighted)
    return np.linalg.solve(normal, weighted.swapaxes(1, 2))[:, 2]
