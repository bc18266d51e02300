"""The LED's spectrum as a sampling dimension of its own."""

from dataclasses import dataclass
from math import erf, exp, log, pi, sqrt
from typing import Any

import numpy as np
from scipy.special import erfinv

from ..renderer import dr

_HALF_WIDTHS = 2.0  # where the Gaussian is cut, in full widths at half maximum: 2.5 millionths are left out
_CUT = _HALF_WIDTHS * sqrt(8 * log(2))  # in standard deviations
_INSIDE = erf(_CUT / sqrt(2))  # of a Gaussian


@dataclass(frozen=True)
class Spectrum:
    """A Gaussian in wavelength, cut two full widths from its middle; a width of 0 is monochromatic light."""

    centre_um: float = 0.525
    fwhm_um: float = 0.030

    def wavelength_um(self, u: Any, parting: float = 1.0) -> Any:
        """Wavelength for a uniform sample ``u`` in [0, 1), a Dr.Jit array: the inverse of the distribution.

        ``parting`` moves it away from the centre.
        """
        sd = self.fwhm_um / sqrt(8 * log(2))
        if sd == 0:
            return type(u)(self.centre_um)
        return dr.fma(parting * sqrt(2) * sd, dr.erfinv(_INSIDE * (2 * u - 1)), self.centre_um)

    @staticmethod
    def parting(shares: int) -> float:
        """By which the middles of so many equal shares must move apart to have the variance of the distribution."""
        if shares == 1:
            return 1.0
        middles = sqrt(2) * erfinv(_INSIDE * ((2 * np.arange(shares) + 1) / shares - 1))
        variance = 1 - _CUT * sqrt(2 / pi) * exp(-(_CUT**2) / 2) / _INSIDE
        return sqrt(variance / float(np.mean(middles**2)))
