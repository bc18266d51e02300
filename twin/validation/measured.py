"""What was measured of one specimen, by which treatment of the phase, and what noise alone would make of it."""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import root_scalar
from scipy.special import erf

from greenough.pipeline.compare import ErrorRow
from greenough.pipeline.reconstruct import PointMap

from ..bench import Truth
from .setup import Setup

RAW, FILTERED, DECONVOLVED, DECONVOLVED_FILTERED = "raw", "filtered", "deconvolved", "deconvolved_filtered"
"""What is done to a phase map. Names of its rows and clouds end so, unless nothing is."""

SHINY = ("coin", "bga")
"""Metal and solder: several exposures are merged, and what their blur costs must be deconvolved."""

P95_LIMIT_UM, BIAS_LIMIT_UM, VALID_SHARE_LIMIT = 4.0, 1.0, 0.98
"""What smooth surfaces must keep to, unaligned."""

_PIXELS = 20_000  # that stand for all when noise is predicted


@dataclass(frozen=True, eq=False)
class Measured:
    """One specimen: its picture, its points, the truth of each pixel, and what a comparison of both says."""

    name: str
    treatment: str  # what was done to the phase
    background: np.ndarray  # (rows, cols) DN
    points: PointMap
    height_sigma: np.ndarray  # (rows, cols) mm, of the points' heights by the frames' noise
    truth: Truth
    smooth: np.ndarray  # (rows, cols) bool
    error: ErrorRow  # vertical, on the smooth surface
    valid_share: float  # points among the pixels that are lit and seen

    @property
    def suffix(self) -> str:
        """How names of its rows end."""
        return "" if self.treatment == RAW else f"_{self.treatment}"


def filter_name(setup: Setup, treatment: str) -> str:
    """What a row says was done."""
    names = {
        RAW: "none",
        DECONVOLVED: "deconvolved",
        DECONVOLVED_FILTERED: f"deconvolved, {setup.filter_name}",
        FILTERED: setup.filter_name,
    }
    return names[treatment]


def has_limits(setup: Setup, measured: Measured) -> bool:
    """Whether rows must keep to limits: those of the best treatment by the calibration that does not trust the stage.

    The others report what blur, noise and the stage do: so do all of a shiny part where the calibration knows no point
    spread to deconvolve with.
    """
    best = DECONVOLVED_FILTERED if measured.name in SHINY else FILTERED
    return not setup.believes_stage and measured.treatment == best


def with_noise(criterion: str, noise_um: float) -> str:
    """A criterion (of a figure to which blur, interreflections and calibration add) with what noise alone makes."""
    return f"{criterion}; noise alone makes {noise_um:.2f} um" if np.isfinite(noise_um) else criterion


def noise_quantile(sigma: np.ndarray, share: float = 0.95) -> float:
    """What ``share`` of the absolute errors stay below, if they are normal and unbiased, each with its own ``sigma``.

    Solves mean(erf(t / (sqrt(2) sigma))) = share for t, in the unit of ``sigma`` (n,); NaN without any.
    """
    sigma = sigma[np.isfinite(sigma)]
    sigma = sigma[:: max(1, len(sigma) // _PIXELS)].astype(np.float64)
    if len(sigma) == 0:
        return float("nan")
    largest = float(sigma.max())
    if largest == 0:
        return 0.0
    sigma = np.maximum(sigma, 1e-9 * largest)

    def excess(t: float) -> float:
        return float(np.mean(erf(t / (np.sqrt(2) * sigma)))) - share

    return float(root_scalar(excess, bracket=(0.0, 10 * largest)).root)
