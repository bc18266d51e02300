"""Designs the few nodes that plain surfaces are rendered with, so that they blur fringes as the real lenses do.

On a plain surface all that matters is the transfer function of pixel and pupils at the fringes' low frequencies.
Sixteen low-discrepancy nodes err there by up to a tenth, where the surface is out of focus: least squares moves the
nodes until it is right.

``python -m greenough.twin.node_design`` writes ``nodes_plain.csv``, which the package reads.
"""

from pathlib import Path

import numpy as np
from scipy.optimize import least_squares
from scipy.stats import qmc

from .diffraction import geometric_transfer

COUNT = 16
DIMENSIONS = 6  # pixel, camera pupil, projector pupil: two each
TABLE = Path(__file__).with_name("nodes_plain.csv")

# The default optics, mm at the specimen; other ones of similar proportions are served nearly as well.
NA, PIXEL = 0.015, 0.0099
FRINGE = 1 / 0.214  # 1/mm, the densest fringe
DEFOCUS = (0.0, 0.4, 0.75, 1.1, 1.5)
START_SEED = 2  # of the starts 0 to 2 the one with the least residual


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
    return np.cos(2 * np.pi * (displacement(u[:, :2]) + camera + projector) @ at.T).mean(axis=0)


def exact(at: np.ndarray, defocus: float, share: float) -> np.ndarray:
    """What ``transfer`` should be: the tent of the sensor's ``pixel_ray`` and the defocused cones of rays, (m,)."""
    tent = (np.sinc(at[:, 0] * PIXEL) * np.sinc(at[:, 1] * PIXEL)) ** 2
    return tent * geometric_transfer(np.hypot(*at.T), NA, defocus) ** (2 if share else 1)


def displacement(u: np.ndarray) -> np.ndarray:
    """Where in mm the light of a pixel is sampled, (n, 2), for samples ``u`` (n, 2)."""
    t = 2 * u - 1
    return np.copysign(1 - np.sqrt(1 - np.abs(t)), t) * PIXEL


def disk(u: np.ndarray) -> np.ndarray:
    """Shirley and Chiu's concentric map of the unit square to the unit disk, (n, 2)."""
    x, y = (2 * u - 1).T
    wide = np.abs(x) > np.abs(y)
    radius = np.where(wide, x, y)
    with np.errstate(divide="ignore", invalid="ignore"):
        angle = np.where(wide, np.pi / 4 * y / x, np.pi / 2 - np.pi / 4 * x / y)
    angle = np.where(radius == 0, 0.0, angle)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=-1)


def residual(half: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Errors of the transfer function at all frequencies, defocuses and directions of the pattern."""
    cases = [(z, share) for z in DEFOCUS for share in ((0.0,) if z == 0 else (0.0, 1.0, -1.0))]
    return np.concatenate([transfer(half, at, z, share) - exact(at, z, share) for z, share in cases])


def design() -> np.ndarray:
    """The nodes, (16, 6): eight that are fitted and their mirror images."""
    start = qmc.Sobol(DIMENSIONS, rng=np.random.default_rng(START_SEED)).random(COUNT // 2)
    at = frequencies()
    fit = least_squares(
        lambda v: residual(v.reshape(-1, DIMENSIONS), at), np.clip(start, 0.02, 0.98).ravel(), bounds=(1e-3, 1 - 1e-3)
    )
    half = np.round(fit.x.reshape(-1, DIMENSIONS), 6)
    return np.concatenate([half, 1 - half])


if __name__ == "__main__":
    np.savetxt(TABLE, design(), fmt="%.6f", delimiter=",", header="pixel u v, camera pupil u v, projector pupil u v")
