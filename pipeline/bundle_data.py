"""What the bundle is fitted to, from phase maps: the phase at each spot, and block averages of the blank planes."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from greenough.instrument.errors import InputError

from .decode import PhaseMap
from .spots import Spots

INNER_SHARE = 0.65
"""Of a spot's radius, within which its phase is taken: at the rim blur mixes in the ink's light, which has another
phase. A small spot of 8.7 px keeps 3 px from its rim, more than the Airy radius of 2.2 px. What is left over is odd
about the centre and does not move the phase there."""

RING = 1.35, 1.9
"""Of a dark spot's radius, between which the phase around it is taken: far enough from the ink, and not as far as the
next spot of a grid whose spots fill half of the pitch."""

MIN_SPOT_PHASES = 50

_MIN_PIXELS = 12  # of a spot's interior
_MIN_SHARE = 0.8  # of these that must be valid
_GRID_COLS = 40  # blocks across the picture: fields of degree 6 need few
_MIN_FILL = 0.75  # of a block's pixels that must be valid


@dataclass(frozen=True, eq=False)
class SpotPhases:
    """Phase at the spots of one picture, in the board's order; NaN where it could not be measured.

    Parameters
    ----------
    phase_rad : (n,)
        Absolute phase at the measured centre.
    gradient_rad : (n, 2)
        Its change per px along u and v on the board: it carries the phase from the measured centre to another place.
    sigma_rad : (n,)
        Standard deviation of ``phase_rad`` from the fit's own residual.
    """

    phase_rad: np.ndarray
    gradient_rad: np.ndarray
    sigma_rad: np.ndarray


@dataclass(frozen=True, eq=False)
class PlaneBlocks:
    """One blank plane, averaged over blocks of pixels.

    Parameters
    ----------
    pixels : (n, 2)
        Mean (u, v) of each block's valid pixels.
    phase_rad : (n,)
        Their mean phase.
    """

    pixels: np.ndarray
    phase_rad: np.ndarray


@dataclass(frozen=True, eq=False)
class BundleData:
    """All observations: for each posture the spots and their phases, and the blank planes."""

    spots: tuple[Spots, ...]
    phases: tuple[SpotPhases, ...]
    planes: tuple[PlaneBlocks, ...]


def measure_spot_phases(phase_map: PhaseMap, spots: Spots, dark: bool = False) -> SpotPhases:
    """Fit a plane to the phase within each spot, or where spots are dark in a ring around it.

    The phase of single pixels has some 0.3 rad from one to the next and noise of 0.01 rad; a plane through the
    interior of a spot gives the phase at its centre, free of what the rim's blur does to either side.
    """
    n = len(spots.seen)
    phase, gradient, sigma = np.full(n, np.nan), np.full((n, 2), np.nan), np.full(n, np.nan)
    rows, cols = phase_map.absolute.shape
    for k in np.flatnonzero(spots.seen):
        (u, v), axes = spots.centres_px[k], spots.axes_px[k]
        hole, reach = (RING[0] * axes.max(), RING[1] * axes.max()) if dark else (0.0, INNER_SHARE * axes.min())
        left, right = max(0, int(np.ceil(u - reach))), min(cols, int(u + reach) + 1)
        top, bottom = max(0, int(np.ceil(v - reach))), min(rows, int(v + reach) + 1)
        dv, du = np.mgrid[top:bottom, left:right] - np.array([v, u]).reshape(2, 1, 1)
        disc = (du**2 + dv**2 <= reach**2) & (du**2 + dv**2 >= hole**2)
        window = phase_map.absolute[top:bottom, left:right].astype(float)
        inside = disc & phase_map.valid[top:bottom, left:right]
        if inside.sum() < max(_MIN_PIXELS, _MIN_SHARE * disc.sum()):
            continue
        design = np.column_stack([np.ones(inside.sum()), du[inside], dv[inside]])
        values = window[inside]
        inverse = np.linalg.inv(design.T @ design)
        fitted = inverse @ (design.T @ values)
        variance = np.sum((values - design @ fitted) ** 2) / (len(values) - 3)
        phase[k], gradient[k], sigma[k] = fitted[0], fitted[1:], np.sqrt(variance * inverse[0, 0])
    return SpotPhases(phase, gradient, sigma)


def no_spot_phases(spots: Spots) -> SpotPhases:
    """Where nothing was measured: spots in white light."""
    n = len(spots.seen)
    return SpotPhases(np.full(n, np.nan), np.full((n, 2), np.nan), np.full(n, np.nan))


def check_spot_phases(phases: Sequence[SpotPhases]) -> None:
    """Raise InputError unless enough phases were measured at spots to start the projector's model from."""
    count = sum(int(np.isfinite(each.sigma_rad).sum()) for each in phases)
    if count < MIN_SPOT_PHASES:
        raise InputError(
            f"the projector cannot be calibrated from {count} spots with a phase in {len(phases)} postures: at least "
            f"{MIN_SPOT_PHASES} are needed; lay the board more into the projector's light"
        )


def block_averages(image: np.ndarray) -> PlaneBlocks:
    """Averages over square blocks, 40 across the picture, of a map (rows, cols) that is NaN where invalid.

    Blocks with less than three quarters of their pixels valid are left out. Where the phase bends across a block its
    mean departs from the phase at the mean pixel by 1e-4 rad, alike everywhere.
    """
    valid = np.isfinite(image)
    v, u = (np.arange(float(n)) for n in image.shape)
    count = _block_sums(valid.astype(float), block_side(image.shape[1]))
    means = [_block_means(values, count) for values in (valid * u, valid * v[:, None], np.where(valid, image, 0.0))]
    enough = np.isfinite(means[0])
    u, v, phase = (mean[enough] for mean in means)
    return PlaneBlocks(np.stack([u, v], axis=-1), phase)


def block_side(cols: int) -> int:
    """Pixels along the side of a block, in a picture of so many columns."""
    return max(1, cols // _GRID_COLS)


def block_map(image: np.ndarray) -> np.ndarray:
    """Means (grid rows, grid cols) over the blocks of `block_averages`, NaN where too few pixels are valid."""
    valid = np.isfinite(image)
    return _block_means(np.where(valid, image, 0.0), _block_sums(valid.astype(float), block_side(image.shape[1])))


def _block_means(image: np.ndarray, count: np.ndarray) -> np.ndarray:
    """Means over blocks of a map that is zero where invalid, of which ``count`` pixels are valid."""
    side = block_side(image.shape[1])
    return np.where(count >= _MIN_FILL * side * side, _block_sums(image, side) / np.maximum(count, 1), np.nan)


def _block_sums(image: np.ndarray, side: int) -> np.ndarray:
    rows, cols = (n // side for n in image.shape)
    bands = image[: rows * side, : cols * side].reshape(rows, side, cols * side).sum(axis=1, dtype=float)
    return bands.reshape(rows, cols, side).sum(axis=2)
