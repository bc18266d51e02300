"""How far a calibration may displace the points that are measured with it, and which of them together.

A calibration errs by causes that are independent of each other: directions of its parameters' covariance, the board's
certificate, drifts. What one standard deviation of one cause does to points is a smooth field over the measuring volume
and is kept as its values on a coarse grid of pixels and heights, whatever the method. Points near each other are
displaced alike, so that the uncertainty of a distance is not that of its ends: see `propagation`.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import RegularGridInterpolator

from greenough.instrument.contract import KnownUncertainty

from .blas import on_one_thread
from .covariance import covariance_root
from .instrument_model import InstrumentModel

GRID = (7, 13, 17)
"""Heights, rows and columns of the grid: fields of degree 6 bend twice between three of its nodes at most."""

_NEGLIGIBLE_MM = 1e-7  # root mean square displacement of a cause that is left out
_AXES = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))  # of a symmetric matrix's six entries


@dataclass(frozen=True, eq=False)
class CalibrationUncertainty:
    """Independent causes of error, each by what its standard deviation does.

    Parameters
    ----------
    heights_mm : (h,)
    grid_v_px : (r,)
    grid_u_px : (c,)
        The grid's nodes, rising.
    modes_mm : (k, h, r, c, 3) float32
        Displacement of x, y and z that one standard deviation of each of ``k`` causes makes.
    pattern_sd_mm : (h,)
        Standard deviation of heights besides, independent from pixel to pixel but the same in every measurement: what
        the planes' noise leaves in relations that are fitted pixel by pixel. Zero for smooth models.
    """

    heights_mm: np.ndarray
    grid_v_px: np.ndarray
    grid_u_px: np.ndarray
    modes_mm: np.ndarray
    pattern_sd_mm: np.ndarray

    def displacements(self, pixels: np.ndarray, z: np.ndarray) -> np.ndarray:
        """What each cause does (n, 3, k), mm, to points at heights (n,) that pixels (n, 2) u, v see.

        Linear between the grid's nodes, beyond them as at the outermost. NaN where z is.
        """
        return self._between(np.moveaxis(self.modes_mm, 0, -1), pixels, z)

    def covariance(self, pixels: np.ndarray, z: np.ndarray) -> np.ndarray:
        """Covariance (n, 3, 3), mm², of points at heights (n,) that pixels (n, 2) u, v see, each for itself.

        The pixels' own pattern is in it; it counts in z alone: x and y follow by a tenth of it.
        """
        upper = np.stack([np.sum(self.modes_mm[..., i] * self.modes_mm[..., j], axis=0) for i, j in _AXES], axis=-1)
        upper[..., -1] += np.square(self.pattern_sd_mm)[:, None, None]
        values = self._between(upper, pixels, z)  # (n, 6)
        result = np.empty((len(z), 3, 3))
        for k, (i, j) in enumerate(_AXES):
            result[:, i, j] = result[:, j, i] = values[:, k]
        return result

    def joined(self, modes_mm: np.ndarray) -> "CalibrationUncertainty":
        """The same with further independent causes that displace all points alike, (k, 3) mm."""
        everywhere = np.broadcast_to(modes_mm[:, None, None, None], (len(modes_mm), *self.modes_mm.shape[1:]))
        return replace(self, modes_mm=np.concatenate([self.modes_mm, everywhere.astype(np.float32)]))

    def _between(self, values: np.ndarray, pixels: np.ndarray, z: np.ndarray) -> np.ndarray:
        nodes = (self.heights_mm, self.grid_v_px, self.grid_u_px)
        at = [np.clip(place, axis[0], axis[-1]) for place, axis in zip((z, *pixels[:, ::-1].T), nodes, strict=True)]
        return RegularGridInterpolator(nodes, values, bounds_error=False)(np.stack(at, axis=-1))


def grid_nodes(
    shape: tuple[int, int], z_low: float, z_high: float
) -> tuple[tuple[np.ndarray, np.ndarray, np.ndarray], np.ndarray, np.ndarray]:
    """Nodes over a picture of ``shape`` and from ``z_low`` to ``z_high`` mm.

    Returns
    -------
    (heights (h,), grid_v (r,), grid_u (c,)), pixels (h r c, 2) u v, z (h r c,)
    """
    rows, cols = shape
    ends = ((z_low, z_high), (0, rows - 1), (0, cols - 1))
    heights, v, u = (np.linspace(*of, n) for of, n in zip(ends, GRID, strict=True))
    z, grid_v, grid_u = (part.ravel() for part in np.meshgrid(heights, v, u, indexing="ij"))
    return (heights, v, u), np.stack([grid_u, grid_v], axis=-1), z


@on_one_thread
def essential(displacements: np.ndarray) -> np.ndarray:
    """As few causes as make the same covariances: (k, h, r, c, 3) float32 from displacements (h r c, 3, n), mm.

    Independent causes of unit variance may be rotated into each other. Those that displace points by less than 0.1 nm
    RMS are dropped.
    """
    nodes = len(displacements)
    left, sizes, _ = np.linalg.svd(displacements.reshape(3 * nodes, -1), full_matrices=False)
    kept = sizes > _NEGLIGIBLE_MM * np.sqrt(3 * nodes)
    return np.moveaxis(left[:, kept] * sizes[kept], -1, 0).reshape(-1, *GRID, 3).astype(np.float32)


@on_one_thread
def uncertainty_of_model(
    instrument: InstrumentModel,
    z_low: float,
    z_high: float,
    known: KnownUncertainty,
    drift_share: float,
) -> CalibrationUncertainty:
    """Of a global model with its parameters' covariance, from ``z_low`` to ``z_high`` mm.

    Parameters
    ----------
    instrument : InstrumentModel
    z_low, z_high : float
    known : KnownUncertainty
    drift_share : float
        Exposures that had been taken when the board lay flat, over those of a whole calibration: by so much of its
        variance the table had drifted when the world's frame was defined.
    """
    nodes, pixels, z = grid_nodes(instrument.camera.camera.shape, z_low, z_high)
    points = instrument.points(pixels, z)
    displacements = np.concatenate(
        [
            instrument.sensitivity(points) @ covariance_root(instrument.covariance),
            (known.board_scale * points)[..., None],
            np.broadcast_to(frame_drift(known, drift_share), (len(z), 3, 3)),
        ],
        axis=-1,
    )
    return CalibrationUncertainty(*nodes, essential(displacements), np.zeros(len(nodes[0])))


def frame_drift(known: KnownUncertainty, share: float) -> np.ndarray:
    """What a drift of the table does to the frame, (3, 3): independent along the axes, after ``share`` of its time."""
    return known.table_drift_mm * np.sqrt(share) * np.eye(3)
