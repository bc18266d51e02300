"""How much of a fine relief's height should be left, by the blur that the calibration found and the shading of slopes.

At camera coordinate s a surface z(s) = A cos(2π f s) turns the phase of fringes with the spatial frequency f0 by
κ cos(2π f s), and its slopes change the light that a Lambertian surface sends back by the share ε sin(2π f s). The
phasor exp(2πi f0 s) (1 + iκ cos + ε sin) so has two sidebands, i (κ - ε) / 2 at f0 + f and i (κ + ε) / 2 at f0 - f, and
the blur passes each by its transfer function M. Relative to that of the fringes, what is left of κ is

    [M(f0 + f) + M(f0 - f)] / 2 M(f0) + (ε / κ) [M(f0 - f) - M(f0 + f)] / 2 M(f0).

With the camera's axis leaning by a from z to one side and the projector's by b to the other, fringes of the period
P = 1 / f0 at s move by (tan a cos b + sin b) z, so κ = -2π f0 (tan a cos b + sin b) A, and ε = 2π f A tan b: what falls
towards the projector's side faces it and is brighter. They have opposite signs and the height is lowered. Along the
fringes the slopes do not change the light, both sidebands are at the frequency √(f0² + f²), and M of that is what is
left.

The one filter works on the phase with its linear course taken out and passes exp(-2 π² σ² f²), as a Gaussian does.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import RegularGridInterpolator
from scipy.optimize import root_scalar

from greenough.instrument.errors import InputError
from greenough.pipeline.decode import PhaseMap

from ..setup import Setup

_FREQUENCIES = 1024  # in a transfer function, to either side


@dataclass(frozen=True)
class ReliefTransfer:
    """Transfer of heights; frequencies and lengths are cycles per px and px.

    Parameters
    ----------
    blur : callable
        M at frequencies (along rows, along columns).
    fringes : float
        f0, along columns.
    shading : float
        -ε f0 / (κ f): tan b / (tan a cos b + sin b).
    filter_sigma : float
        Of the Gaussian; 0 without a filter.
    """

    blur: Callable[[tuple[float, float]], float]
    fringes: float
    shading: float
    filter_sigma: float

    def across(self, frequency: float) -> float:
        """Share of the height that is left of relief along x, across the fringes."""
        above, below = self.blur((0.0, self.fringes + frequency)), self.blur((0.0, abs(self.fringes - frequency)))
        shaded = self.shading * frequency / self.fringes
        left = ((above + below) - shaded * (below - above)) / (2 * self.blur((0.0, self.fringes)))
        return left * self._filtered(frequency)

    def along(self, frequency: float) -> float:
        """Share of the height that is left of relief along y, along the fringes."""
        return self.blur((frequency, self.fringes)) / self.blur((0.0, self.fringes)) * self._filtered(frequency)

    def limit_px(self, axis: str) -> float:
        """Longest period of which only half the height is left along "x" or "y"."""
        transfer = {"x": self.across, "y": self.along}[axis]
        periods = np.geomspace(100.0, 2.05, 400)
        first = int(np.argmax([transfer(1 / period) < 0.5 for period in periods]))
        found = root_scalar(lambda period: transfer(1 / period) - 0.5, bracket=(periods[first], periods[first - 1]))
        return float(found.root)

    def _filtered(self, frequency: float) -> float:
        return float(np.exp(-2 * (np.pi * self.filter_sigma * frequency) ** 2))


def relief_transfer(setup: Setup, phase_map: PhaseMap, where: np.ndarray, filtered: bool) -> ReliefTransfer:
    """Of what is seen at height 0 in the pixels ``where`` (rows, cols).

    Raises
    ------
    InputError
        If the calibration knows no point spread.
    """
    spread = setup.calibration.point_spread
    if spread is None:
        raise InputError("the calibration holds no point spread to predict a resolution by; calibrate with more spots")
    v, u = np.nonzero(where)
    radius = float(np.sqrt(np.mean(spread.disc_radius_px(np.stack([u, v], axis=-1), np.zeros(len(u))) ** 2)))
    transfer = spread.transfer((2 * _FREQUENCIES, 2 * _FREQUENCIES), radius)[:_FREQUENCIES, :_FREQUENCIES]
    frequency = np.arange(_FREQUENCIES) / (2 * _FREQUENCIES)
    interpolate = RegularGridInterpolator((frequency, frequency), transfer, bounds_error=False, fill_value=0.0)
    per_px = np.diff(phase_map.absolute, axis=1)[where[:, 1:] & where[:, :-1]]
    lean = np.radians(setup.bench.settings.optics.convergence_deg) / 2
    return ReliefTransfer(
        blur=lambda at: np.asarray(interpolate(at)).item(),
        fringes=float(abs(np.nanmedian(per_px)) / (2 * np.pi)),
        shading=float(np.tan(lean) / (np.tan(lean) * np.cos(lean) + np.sin(lean))),
        filter_sigma=setup.filter_fwhm_px / float(np.sqrt(8 * np.log(2))) if filtered else 0.0,
    )
