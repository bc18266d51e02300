"""Optical glasses: refractive index against wavelength."""

from dataclasses import dataclass
from typing import Any

from ..renderer import dr

AIR = "air"


@dataclass(frozen=True)
class Glass:
    """Sellmeier's formula, n² = 1 + Σ strength λ² / (λ² - resonance), λ in µm, relative to air."""

    strengths: tuple[float, float, float]
    resonances_um2: tuple[float, float, float]


# Schott's data sheets.
GLASSES = {
    "N-BK7": Glass((1.03961212, 0.231792344, 1.01046945), (0.00600069867, 0.0200179144, 103.560653)),
    "N-SF5": Glass((1.52481889, 0.187085527, 1.42729015), (0.011254756, 0.0588995392, 129.141675)),
    "N-BAF10": Glass((1.5851495, 0.143559385, 1.08521269), (0.00926681282, 0.0424489805, 105.613573)),
    "N-SF6": Glass((1.77931763, 0.338149866, 2.08734474), (0.0133714182, 0.0617533621, 174.01759)),
}


def index(glass: str, wavelength_um: Any) -> Any:
    """Refractive index of ``glass``, a name of GLASSES or "air", which is 1.

    ``wavelength_um`` is a float or a Dr.Jit array; the index is of its type, but a plain 1.0 in air.
    """
    if glass == AIR:
        return 1.0
    data = GLASSES[glass]
    square = wavelength_um * wavelength_um
    terms = [b * square / (square - c) for b, c in zip(data.strengths, data.resonances_um2, strict=True)]
    return dr.sqrt(1 + terms[0] + terms[1] + terms[2])
