"""How bright a lit surface looks, after the textbooks: a second opinion on what the renderer does.

Directions are unit vectors (..., 3) that point away from the surface.
"""

import numpy as np

from greenough.scenes.materials import Diffuse, Material, RoughConductor, RoughPlastic


def radiance(material: Material, normal: np.ndarray, to_light: np.ndarray, to_eye: np.ndarray) -> np.ndarray:
    """Radiance towards the eye under unit irradiance on a surface that faces the light, (...).

    Zero where light or eye are behind the surface. The interface of a rough plastic transmits like a smooth one.
    """
    cos_light, cos_eye = _dot(normal, to_light), _dot(normal, to_eye)
    both = (cos_light > 0) & (cos_eye > 0)
    cos_light, cos_eye = np.where(both, cos_light, 1.0), np.where(both, cos_eye, 1.0)
    match material:
        case Diffuse(reflectance):
            seen = reflectance / np.pi * cos_light
        case RoughConductor(alpha, reflectance):
            seen = reflectance * _microfacets(alpha, normal, to_light, to_eye, cos_light, cos_eye)
        case RoughPlastic(alpha, reflectance, ior):
            half = _unit(to_light + to_eye)
            coat = fresnel(_dot(half, to_light), ior)
            coat *= _microfacets(alpha, normal, to_light, to_eye, cos_light, cos_eye)
            through = (1 - fresnel(cos_light, ior)) * (1 - fresnel(cos_eye, ior)) / (1 - mean_fresnel(ior))
            seen = coat + reflectance / np.pi * through * cos_light
    return np.where(both, seen, 0.0)


def ggx(cos_half: np.ndarray, alpha: float) -> np.ndarray:
    """GGX distribution of microfacet normals at ``cos_half`` to the surface's normal."""
    return alpha**2 / (np.pi * np.square(1 + np.square(cos_half) * (alpha**2 - 1)))


def masking(cosine: np.ndarray, alpha: float) -> np.ndarray:
    """Smith's share of GGX microfacets that are not hidden from a direction at ``cosine`` to the normal."""
    square = np.square(cosine)
    return 2 / (1 + np.sqrt(1 + alpha**2 * (1 - square) / square))


def fresnel(cosine: np.ndarray, ior: float) -> np.ndarray:
    """Reflectance of a smooth dielectric for unpolarised light that comes from outside."""
    inside = np.sqrt(1 - (1 - np.square(cosine)) / ior**2)
    across = (cosine - ior * inside) / (cosine + ior * inside)
    along = (ior * cosine - inside) / (ior * cosine + inside)
    return (np.square(across) + np.square(along)) / 2


def mean_fresnel(ior: float) -> float:
    """Reflectance of a smooth dielectric for light that comes equally from all sides outside."""
    node, weight = np.polynomial.legendre.leggauss(64)
    square = (node + 1) / 2  # of the cosine: flux is uniform in it
    return float((weight / 2 * fresnel(np.sqrt(square), ior)).sum())


def _microfacets(
    alpha: float,
    normal: np.ndarray,
    to_light: np.ndarray,
    to_eye: np.ndarray,
    cos_light: np.ndarray,
    cos_eye: np.ndarray,
) -> np.ndarray:
    """D G / (4 cos_eye): radiance of facets that reflect everything."""
    density = ggx(_dot(normal, _unit(to_light + to_eye)), alpha)
    return density * masking(cos_light, alpha) * masking(cos_eye, alpha) / (4 * cos_eye)


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.einsum("...k,...k->...", a, b)


def _unit(a: np.ndarray) -> np.ndarray:
    return a / np.linalg.norm(a, axis=-1, keepdims=True)
