"""Surfaces by their optical parameters at the instrument's one wavelength, 525 nm."""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType


@dataclass(frozen=True)
class Diffuse:
    """Lambertian: the same radiance in every direction."""

    reflectance: float


@dataclass(frozen=True)
class RoughConductor:
    """Metal with GGX-distributed microfacets of roughness ``alpha``, each reflecting ``reflectance`` at any angle."""

    alpha: float
    reflectance: float


@dataclass(frozen=True)
class RoughPlastic:
    """Diffuse base of albedo ``reflectance`` under a dielectric with GGX roughness ``alpha`` and index ``ior``."""

    alpha: float
    reflectance: float
    ior: float


Material = Diffuse | RoughConductor | RoughPlastic

MATERIALS: Mapping[str, Material] = MappingProxyType(
    {
        "ceramic": Diffuse(0.85),
        "ink": Diffuse(0.08),
        "matte": Diffuse(0.6),
        "metal": RoughConductor(alpha=0.25, reflectance=0.6),
        "solder": RoughConductor(alpha=0.2, reflectance=0.75),
        "substrate": RoughPlastic(alpha=0.3, reflectance=0.2, ior=1.5),
        "film": RoughPlastic(alpha=0.3, reflectance=0.5, ior=1.5),
    }
)
