"""The LED's spectrum as a sampling dimension of its own."""

from dataclasses import dataclass
from math import erf, log, sqrt
from typing import Any

from ..renderer import dr

_HALF_WIDTHS = 2.0  # where the Gaussian is cut, in full widths at half maximum: 2.5 millionths are left out


@dataclass(frozen=True)
class Spectrum:
    """A Gaussian in wavelength, cut two full widths from its middle; a width of 0 is monochromatic light."""

    centre_um: float = 0.525
    fwhm_um: float = 0.030

    def wavelength_um(self, u: Any) -> Any:
        """Wavelength for a uniform sample ``u`` in [0, 1), a Dr.Jit array: the inverse of the distribution."""
        sd = self.fwhm_um / sqrt(8 * log(2))
        if sd == 0:
            return type(u)(self.centre_um)
        share = erf(_HALF_WIDTHS * sqrt(8 * log(2)) / sqrt(2))
        return dr.fma(sqrt(2) * sd, dr.erfinv(share * (2 * u - 1)), self.centre_um)
