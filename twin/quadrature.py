"""Quadrature nodes of a light path: one set, the same in every pixel."""

from pathlib import Path

import numpy as np
from scipy.stats import qmc

DESIGNED = Path(__file__).with_name("nodes")
"""Tables of designed nodes, each named after how many it has; ``node_design`` writes them."""


def nodes(count: int, dimensions: int) -> np.ndarray:
    """``count`` nodes in the unit cube, (count, dimensions) float32.

    Half of them are a scrambled Sobol sequence with a fixed scrambling, the others its mirror image 1 - u: every odd
    moment of a symmetric distribution, such as the centroid of a pixel or a pupil, is then exactly zero.

    Raises ValueError unless ``count`` is a power of two of at least 2.
    """
    if count < 2 or count & (count - 1):
        raise ValueError(f"the number of nodes must be a power of two of at least 2, not {count}")
    half = qmc.Sobol(dimensions, rng=np.random.default_rng(1)).random(count // 2)
    return np.clip(np.concatenate([half, 1 - half]), 1e-6, 1 - 1e-6).astype(np.float32)


def nodes_of_direct_light(count: int) -> np.ndarray:
    """``count`` nodes of pixel and pupils, (count, 6) float32: those of ``node_design`` where it has so many.

    Raises ValueError as ``nodes`` does.
    """
    designed = DESIGNED / f"{count}.csv"
    if not designed.exists():
        return nodes(count, 6)
    return np.loadtxt(designed, delimiter=",", dtype=np.float32)
