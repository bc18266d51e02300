"""Designs the nodes of the direct light, so that they blur fringes as the real lenses do.

On a smooth surface all that matters is the transfer function of pixel and pupils at the fringes' low frequencies, and
that place in the pixel and in the pupils are not correlated: pencils that a rim has cut, or that are brighter on one
side, would shift the picture. Low-discrepancy nodes err there, few as they are; least squares moves them until both
are nearly right. What is left of their even spread serves edges and shadows.

``python -m greenough.twin.node_design`` writes ``nodes/16.csv`` and so on, which the package reads.
"""

from itertools import combinations_with_replacement
from math import gamma, prod

import numpy as np
from scipy.optimize import least_squares
from scipy.stats import qmc

from .diffraction import geometric_transfer
from .quadrature import DESIGNED

COUNTS = (16, 32, 64, 128)
DIMENSIONS = 6  # pixel, camera pupil, projector pupil: two each

# The default optics, mm at the specimen.
NA, PIXEL = 0.015, 0.0099
FRINGE = 1 / 0.214  # 1/mm, the densest fringe
DEFOCUS = (0.0, 0.4, 0.75, 1.1, 1.5)
START_SEED = 1
STAY = 0.01  # weight of how far the nodes move from where they start
SECOND = DIMENSIONS * (DIMENSIONS + 1) // 2  # products of two coordinates
SECOND_WEIGHT = 30.0  # whatever depends on place and direction is seen alike by all tables if these are right
FOURTH = 0.1  # weight of products of four coordinates: few nodes cannot have them all right


def frequencies() -> np.ndarray:
    """Where the transfer function is fitted, (n, 2) in 1/mm: the fringe across its lines, and rings around zero."""
    radius, angle = np.meshgrid([1.5, 3.0, FRINGE, 6.5, 9.0], np.radians([0, 30, 60, 90, 120, 150]))
    ring = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=-1).reshape(-1, 2)
    return np.concatenate([ring, np.tile([[FRINGE, 0.0]], (4, 1))])  # the fringe itself weighs four times more


def transfer(u: np.ndarray, at: np.ndarray, defocus: float, share: float) -> np.ndarray:
    """Transfer function of symmetric nodes, half of which are ``u`` (n, 6), at frequencies (m, 2).

    ``share`` is the projector pupil's sign: 0 leaves it out, 1 and -1 are a pattern seen in and against its direction.
    """
    camera = defocus * NA * disk(u[:, 2:4])
    projector = share * defocus * NA * disk(u[:, 4:6])
    return np.cos(2 * np.pi * (PIXEL * tent(u[:, :2]) + camera + projector) @ at.T).mean(axis=0)


def exact(at: np.ndarray, defocus: float, share: float) -> np.ndarray:
    """What ``transfer`` should be: the tent of the sensor's ``pixel_ray`` and the defocused cones of rays, (m,)."""
    pixel = (np.sinc(at[:, 0] * PIXEL) * np.sinc(at[:, 1] * PIXEL)) ** 2
    return pixel * geometric_transfer(np.hypot(*at.T), NA, defocus) ** (2 if share else 1)


def moments(u: np.ndarray) -> np.ndarray:
    """Errors of the means of all products of two coordinates, the first ``SECOND``, and of four.

    Of symmetric nodes as above; coordinates are those of the tent and of the two unit disks. Odd products vanish.
    """
    x = np.concatenate([tent(u[:, :2]), disk(u[:, 2:4]), disk(u[:, 4:6])], axis=1).T  # (6, n)
    products = [c for degree in (2, 4) for c in combinations_with_replacement(range(DIMENSIONS), degree)]
    return np.array([np.prod(x[list(c)], axis=0).mean() - expected(c) for c in products])


def expected(product: tuple[int, ...]) -> float:
    """Mean of a product of coordinates, each given by its number: tent x and y, camera x and y, projector x and y."""
    powers = [product.count(k) for k in range(DIMENSIONS)]
    if any(power % 2 for power in powers):
        return 0.0
    in_tent = prod(2 / ((p + 1) * (p + 2)) for p in powers[:2])
    return in_tent * prod(_in_disk(*powers[k : k + 2]) for k in (2, 4))


def _in_disk(a: int, b: int) -> float:
    """Mean of x^a y^b over the unit disk, a and b even."""
    around = gamma((a + 1) / 2) * gamma((b + 1) / 2) / (np.pi * gamma((a + b) / 2 + 1))
    return 2 * around / (a + b + 2)


def tent(u: np.ndarray) -> np.ndarray:
    """Positions under a tent that falls to zero at -1 and 1, for samples ``u``."""
    t = 2 * u - 1
    return np.copysign(1 - np.sqrt(1 - np.abs(t)), t)


def disk(u: np.ndarray) -> np.ndarray:
    """Shirley and Chiu's concentric map of the unit square to the unit disk, (n, 2)."""
    x, y = (2 * u - 1).T
    wide = np.abs(x) > np.abs(y)
    radius = np.where(wide, x, y)
    with np.errstate(divide="ignore", invalid="ignore"):
        angle = np.where(wide, np.pi / 4 * y / x, np.pi / 2 - np.pi / 4 * x / y)
    angle = np.where(radius == 0, 0.0, angle)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=-1)


def blur_error(half: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Errors of the transfer function at all frequencies, defocuses and directions of the pattern."""
    cases = [(z, share) for z in DEFOCUS for share in ((0.0,) if z == 0 else (0.0, 1.0, -1.0))]
    return np.concatenate([transfer(half, at, z, share) - exact(at, z, share) for z, share in cases])


def design(count: int) -> np.ndarray:
    """The nodes, (count, 6): one half that is fitted and its mirror image."""
    start = qmc.Sobol(DIMENSIONS, rng=np.random.default_rng(START_SEED)).random(count // 2)
    start = np.clip(start, 0.01, 0.99)
    at = frequencies()
    weights = np.where(np.arange(len(moments(start))) < SECOND, SECOND_WEIGHT, FOURTH)

    def error(v: np.ndarray) -> np.ndarray:
        half = v.reshape(-1, DIMENSIONS)
        moved = STAY * (half - start).ravel() / np.sqrt(count)
        return np.concatenate([blur_error(half, at), weights * moments(half), moved])

    # What more steps would gain is less than what the nodes do not fit anyway.
    fit = least_squares(error, start.ravel(), bounds=(1e-3, 1 - 1e-3), max_nfev=120)
    half = np.round(fit.x.reshape(-1, DIMENSIONS), 6)
    return np.concatenate([half, 1 - half])


if __name__ == "__main__":
    for count in COUNTS:
        header = "pixel u v, camera pupil u v, projector pupil u v"
        np.savetxt(DESIGNED / f"{count}.csv", design(count), fmt="%.6f", delimiter=",", header=header)
