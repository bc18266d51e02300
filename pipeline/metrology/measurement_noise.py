"""Measurement noise N_M of height maps, after ISO 25178-600: what repeats differ by on the same place.

It is to be measured on the material that matters and with the filter that is used: on shiny or dark parts it is many
times that of a white plane. What two maps have in common, such as the surface and the calibration's errors, drops out.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.fft import irfft2, next_fast_len, rfft2

from greenough.instrument.errors import InputError

_LEAST_PIXELS = 100
_REACH_PX = 16
"""Noise is taken for uncorrelated farther than this: filters reach less far."""


@dataclass(frozen=True)
class MeasurementNoise:
    """Measurement noise of one map.

    Parameters
    ----------
    noise : float
        N_M, mm.
    relative_sd : float
        Standard uncertainty of ``noise`` over itself: 1 / sqrt(2 n_eff) for each map beyond the first.
    maps : int
    n : int
        Pixels with a height in all maps.
    n_eff : float
        Independent values among them: fewer where neighbours' noise is correlated or the noise varies over the map.
    share : float
        ``n`` over the pixels with a height in any map: what lacks in one counts in none.
    mean_differences : tuple of floats
        Mean of each later map less that of the first one, mm: removed, as a drift of the whole is not noise.
    surface_sq : float
        Sq of what the maps have in common, their noise taken off, about its mean, mm; not levelled, 0 if less than the
        noise's own.
    """

    noise: float
    relative_sd: float
    maps: int
    n: int
    n_eff: float
    share: float
    mean_differences: tuple[float, ...]
    surface_sq: float


def noise_by_subtraction(first: np.ndarray, second: np.ndarray) -> MeasurementNoise:
    """N_M = Sq(z1 - z2) / √2 of two successive maps (rows, cols) of the same place, less their mean difference.

    Raises
    ------
    InputError
        If the maps differ in shape or share fewer than 100 pixels with a height.
    """
    heights, measured = _common([first, second])
    difference = heights[1] - heights[0]
    shift = float(difference[measured].mean())
    difference = np.where(measured, difference - shift, 0.0)
    noise = float(np.sqrt(np.sum(difference**2) / measured.sum() / 2))
    n_eff = _independent(difference[None], measured, degrees=1)
    mean_map = heights.mean(axis=0)[measured]
    return MeasurementNoise(
        noise=noise,
        relative_sd=float(1 / np.sqrt(2 * n_eff)),
        maps=2,
        n=int(measured.sum()),
        n_eff=n_eff,
        share=_share([first, second], measured),
        mean_differences=(shift,),
        surface_sq=float(np.sqrt(max(mean_map.var() - noise**2 / 2, 0.0))),
    )


def noise_by_averaging(maps: Sequence[np.ndarray]) -> MeasurementNoise:
    """N_M from how much averaging lowers Sq: Sq_mean² = Sq_surface² + N_M² / m of the mean of m maps.

    With the mean of the single maps' Sq² = Sq_surface² + N_M², the noise is N_M² = (Sq_single² - Sq_mean²) m / (m - 1),
    each Sq about its own map's mean.

    Parameters
    ----------
    maps : sequence of m (rows, cols)
        Heights of the same place, mm; NaN where nothing was measured.

    Raises
    ------
    InputError
        If there are fewer than two maps, they differ in shape, or share fewer than 100 pixels with a height.
    """
    heights, measured = _common(maps)
    means = heights[:, measured].mean(axis=1)
    departures = np.where(measured, heights - means[:, None, None], 0.0)
    count, m = int(measured.sum()), len(heights)
    mean_map = departures.mean(axis=0)
    single, averaged = np.sum(departures**2) / (m * count), np.sum(mean_map**2) / count
    variance = max((single - averaged) * m / (m - 1), 0.0)
    n_eff = _independent(departures - mean_map, measured, degrees=m - 1)
    return MeasurementNoise(
        noise=float(np.sqrt(variance)),
        relative_sd=float(1 / np.sqrt(2 * (m - 1) * n_eff)),
        maps=m,
        n=count,
        n_eff=n_eff,
        share=_share(maps, measured),
        mean_differences=tuple((means[1:] - means[0]).tolist()),
        surface_sq=float(np.sqrt(max(averaged - variance / m, 0.0))),
    )


def _common(maps: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Heights (m, rows, cols), 0 where one lacks, and where none does, (rows, cols) bool."""
    shapes = {np.shape(z) for z in maps}
    if len(maps) < 2 or len(shapes) > 1 or len(next(iter(shapes))) != 2:
        raise InputError(
            f"measurement noise needs two or more maps (rows, cols) of one shape, but got {len(maps)} with shapes "
            f"{', '.join(map(str, sorted(shapes)))}"
        )
    heights = np.array(maps, dtype=float)
    measured = np.asarray(np.isfinite(heights).all(axis=0))
    if measured.sum() < _LEAST_PIXELS:
        raise InputError(
            f"{measured.sum()} pixels have a height in all {len(maps)} maps, and measurement noise needs at least "
            f"{_LEAST_PIXELS}: expose so that the part is seen"
        )
    return np.where(measured, heights, 0.0), measured


def _share(maps: Sequence[np.ndarray], measured: np.ndarray) -> float:
    return float(measured.sum() / np.sum(np.any(np.isfinite(np.array(maps, dtype=float)), axis=0)))


def _independent(departures: np.ndarray, measured: np.ndarray, degrees: int) -> float:
    """Independent values in a map among departures (m, rows, cols), which are 0 outside ``measured`` (rows, cols).

    The variance of Gaussian values' mean square is 2 / n² Σ_ij c_ij² with their covariances c. Where the variance
    changes over the map as σ² and the correlation ρ depends on the lag alone, that is 2 K S mean(σ²)² / n. There
    K = mean(σ⁴) / mean(σ²)² is a third of the departures' kurtosis and S = Σ_l N_l ρ_l² / n over lags l with N_l pairs:
    n_eff = n / (K S). An estimated ρ_l² is too high by S / (N_l ``degrees``) (Bartlett 1946), which the divisor
    takes back: S = (n + Σ N_l ρ_l²) / (n + L / degrees), both over the L lags but 0.
    """
    rows, cols = measured.shape
    reach = min(_REACH_PX, rows - 1, cols - 1)
    size = (next_fast_len(rows + reach, real=True), next_fast_len(cols + reach, real=True))

    def correlation(image: np.ndarray) -> np.ndarray:
        full = np.asarray(irfft2(np.abs(np.asarray(rfft2(image, s=size))) ** 2, s=size))
        return np.roll(full, (reach, reach), axis=(0, 1))[: 2 * reach + 1, : 2 * reach + 1]

    n = float(measured.sum())
    pairs = np.rint(correlation(measured.astype(float)))
    products = sum(correlation(image) for image in departures)
    squares, fourths = np.sum(departures**2), np.sum(departures**4)
    if not squares > 0:
        return n
    kurtosis = fourths * len(departures) * n / squares**2
    rho = products / np.maximum(pairs, 1) / (squares / n)
    rho[reach, reach] = 0
    lags = np.sum(pairs > 0) - 1
    inflation = (n + np.sum(pairs * rho**2)) / (n + lags / degrees)
    return float(n / (max(inflation, 1.0) * max(kurtosis / 3, 1.0)))
