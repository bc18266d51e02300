"""Where a result is judged: rules decided by truth alone, the same for every row."""

import numpy as np

from ..bench import Truth

MAX_DEPARTURE_MM = 1e-3


def smooth(truth: Truth, radius_px: float) -> np.ndarray:
    """Pixels whose surroundings are smooth, (rows, cols) bool.

    Over the disc of ``radius_px`` (half of one Airy diameter) around the true point everything is lit and seen, and
    the surface departs from its best plane by less than 1 um, perpendicular to it. An edge or a shadow's boundary
    within the disc fails that by its jump or by a pixel that is not lit. Where pixels are coarser than the disc, the
    next neighbours speak for it.
    """
    radius_px = max(radius_px, 1.0)
    reach = int(radius_px)
    grid = range(-reach, reach + 1)
    offsets = [(dv, du) for dv in grid for du in grid if du * du + dv * dv <= radius_px * radius_px]
    z = np.pad(np.where(truth.lit_and_seen, truth.xyz[..., 2], np.nan), reach, constant_values=np.nan)
    rows, cols = truth.lit_and_seen.shape

    def neighbour(dv: int, du: int) -> np.ndarray:
        return z[reach + dv : reach + dv + rows, reach + du : reach + du + cols]

    # Offsets are symmetric, so the best plane's height and slopes decouple.
    spread = sum(du * du for _, du in offsets)
    height = sum(neighbour(dv, du) for dv, du in offsets) / len(offsets)
    along = sum(du * neighbour(dv, du) for dv, du in offsets) / spread
    down = sum(dv * neighbour(dv, du) for dv, du in offsets) / spread
    departure = np.zeros((rows, cols))
    for dv, du in offsets:
        departure = np.maximum(departure, np.abs(neighbour(dv, du) - height - along * du - down * dv))
    # np.maximum hands NaN on, and a comparison with NaN is false: unlit neighbours are not smooth.
    return departure * np.abs(truth.normal[..., 2]) < MAX_DEPARTURE_MM
