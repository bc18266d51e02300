"""What a report shows of a measured specimen: picture, points, errors against truth, uncertainties."""

from dataclasses import dataclass

import numpy as np

from greenough.pipeline.reconstruct import PointMap

from .balls import BallGridAsMounted
from .measured import RAW, Measured, filter_name
from .setup import Setup

CALIBRATION_STEP_PX = 4
"""The calibration's uncertainty, which is smooth, is computed in every so-manyth pixel of each row and column."""

_MARGIN_PX = 10


@dataclass(frozen=True, eq=False)
class SpecimenMaps:
    """Maps of one specimen, cut to what was measured; arrays are (rows, cols) unless it says otherwise.

    Parameters
    ----------
    name : str
        The specimen.
    treatment : str
        What was done to the phase, as in `measured`.
    filter : str
        The same as a row of claims says it.
    origin : (int, int)
        Row and column of the first pixel in the camera's picture.
    background : float32
        The picture under even light, DN above black.
    xyz : (rows, cols, 3) float32
        Points, mm, NaN where there is none.
    error_um : float32
        Vertical error, NaN where there is no point or truth does not call the pixel lit and seen.
    smooth : bool
        Where errors count.
    sigma_noise_um : float32 or None
        Standard uncertainty of z by noise.
    sigma_calibration_um : float32 or None
        The same by the calibration, in every ``CALIBRATION_STEP_PX``-th pixel of rows and columns.
    balls_mm : (balls, 2) float64 or None
        Of a ball grid array: apexes' heights above the substrate, measured and true.
    """

    name: str
    treatment: str
    filter: str
    origin: tuple[int, int]
    background: np.ndarray
    xyz: np.ndarray
    error_um: np.ndarray
    smooth: np.ndarray
    sigma_noise_um: np.ndarray | None = None
    sigma_calibration_um: np.ndarray | None = None
    balls_mm: np.ndarray | None = None

    @property
    def title(self) -> str:
        """Name and treatment, as a heading has them."""
        name = "ball-grid array" if self.name == "bga" else self.name.replace("-", ", ")
        words = name if self.treatment == RAW else f"{name}, {self.treatment.replace('_', ', ')}"
        return words[:1].upper() + words[1:]

    @property
    def stem(self) -> str:
        """How names of its files begin."""
        return self.name if self.treatment == RAW else f"{self.name}-{self.treatment.replace('_', '-')}"

    @property
    def height_mm(self) -> np.ndarray:
        """Measured z."""
        return self.xyz[..., 2]

    @property
    def counts(self) -> np.ndarray:
        """Where there is an error that counts."""
        return self.smooth & np.isfinite(self.error_um)


def specimen_maps(setup: Setup, measured: Measured) -> SpecimenMaps:
    """The maps of a measured specimen, which is still mounted.

    Point and truth lie on one camera ray, some µm apart: the vertical error is taken to the tangent plane at the true
    point, which is the surface itself as far as it is smooth.
    """
    points, truth = measured.points, measured.truth
    window = _window(points.valid)
    xyz, normal = points.xyz[window], truth.normal_world[window]
    with np.errstate(divide="ignore", invalid="ignore"):
        error = np.einsum("rci,rci->rc", xyz - truth.xyz_world[window], normal) / normal[..., 2]
    return SpecimenMaps(
        name=measured.name,
        treatment=measured.treatment,
        filter=filter_name(setup, measured.treatment),
        origin=(window[0].start, window[1].start),
        background=measured.background[window].astype(np.float32),
        xyz=xyz.astype(np.float32),
        error_um=np.where(truth.lit_and_seen[window], 1e3 * error, np.nan).astype(np.float32),
        smooth=measured.smooth[window],
        sigma_noise_um=None if points.noise_mm is None else 1e3 * np.abs(points.noise_mm[window][..., 2]),
        sigma_calibration_um=_sigma_calibration(points, window),
        balls_mm=_balls(setup, measured) if measured.name == "bga" else None,
    )


def _sigma_calibration(points: PointMap, window: tuple[slice, slice]) -> np.ndarray | None:
    if points.uncertainty is None:
        return None
    rows, cols = (slice(each.start, each.stop, CALIBRATION_STEP_PX) for each in window)
    z = points.xyz[rows, cols, 2]
    v, u = np.nonzero(np.isfinite(z))
    pixels = np.stack([cols.start + CALIBRATION_STEP_PX * u, rows.start + CALIBRATION_STEP_PX * v], axis=-1)
    sigma = np.full(z.shape, np.nan, dtype=np.float32)
    sigma[v, u] = 1e3 * np.sqrt(points.uncertainty.covariance(pixels, z[v, u])[:, 2, 2])
    return sigma


def _balls(setup: Setup, measured: Measured) -> np.ndarray:
    """Apexes' heights above the substrate, measured and true, (balls, 2) mm, as `balls` judges them."""
    grid = BallGridAsMounted.of(setup.bench)
    points = grid.in_part(measured.points.xyz[measured.truth.lit_and_seen])
    heights = grid.apex_heights(points[np.isfinite(points[:, 2])])
    return np.stack([heights, grid.apexes[:, 2]], axis=-1) - grid.substrate


def _window(wanted: np.ndarray) -> tuple[slice, slice]:
    """Rows and columns that hold everything wanted, with a margin; the whole picture where nothing is."""
    rows, cols = np.flatnonzero(wanted.any(axis=1)), np.flatnonzero(wanted.any(axis=0))
    if len(rows) == 0:
        return slice(0, wanted.shape[0]), slice(0, wanted.shape[1])
    down, across = (
        slice(max(0, int(seen[0]) - _MARGIN_PX), min(length, int(seen[-1]) + 1 + _MARGIN_PX))
        for seen, length in zip((rows, cols), wanted.shape, strict=True)
    )
    return down, across
