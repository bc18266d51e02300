"""Mapping deviation in x and y by the marks of a cross or dot grating, after ISO 25178-600 and -700.

Certified positions are taken onto the measured ones by a similarity, as nobody knows how the grating lay; what is left
is the mapping deviation. Its scale is a result and not a deviation: where the grating's certificate is independent of
what calibrated the instrument, it is the test of the instrument's scale.
"""

from dataclasses import dataclass

import numpy as np

from greenough.instrument.errors import InputError

from .flatness import fit_plane

LEAST_MARKS = 6


@dataclass(frozen=True, eq=False)
class MappingDeviation:
    """Measured against certified positions of a grating's marks.

    Parameters
    ----------
    n : int
        Marks that were measured, of ``of``.
    of : int
        Marks of the grating.
    scale, rotation : float
        Of the best similarity from certified to measured, 1 and rad.
    deviations : (of, 2) float64
        Measured position less that of the similarity, mm; NaN where a mark was not measured.
    largest : float
        Length of the longest deviation, mm.
    rms : float
        Root mean square length of the deviations, mm.
    alpha_x, alpha_y : float
        Amplification coefficients along the instrument's axes: those of the best affine map, after a rotation, from
        certified to measured.
    squareness : float
        By how much the angle between the instrument's axes, as they appear in a measurement, exceeds a right one, rad.
    alpha_x_sd, alpha_y_sd, squareness_sd : float
        Their standard deviations by the marks' scatter about the affine map, errors taken for independent.
    """

    n: int
    of: int
    scale: float
    rotation: float
    deviations: np.ndarray
    largest: float
    rms: float
    alpha_x: float
    alpha_y: float
    squareness: float
    alpha_x_sd: float
    alpha_y_sd: float
    squareness_sd: float


def mapping_deviation(measured: np.ndarray, certified: np.ndarray) -> MappingDeviation:
    """Mapping deviation from measured and certified positions (n, 2) of the same marks in the same order.

    With positions as complex numbers about their means, the similarity of least squares is multiplication by
    Σ conj(certified) measured / Σ |certified|². Of the affine map's matrix M = P R, a rotation R followed by a
    symmetric P that stretches along axes of its own, P is what the instrument does: its diagonal is alpha_x and
    alpha_y. Marks with places c in the instrument's axes and a scatter of variance σ² along either axis give each row
    of M the covariance σ² C with C = (Σ c cᵀ)⁻¹; to first order alpha_x has the variance σ² C_xx, alpha_y σ² C_yy, and
    squareness, the sum of the two entries off the diagonal, σ² (C_xx + C_yy).

    Parameters
    ----------
    measured : (n, 2)
        mm; NaN where a mark was not measured. Marks of a grating that lies tilted come from :func:`in_plane`.
    certified : (n, 2)
        mm.

    Raises
    ------
    InputError
        If the arrays do not go together, fewer than 6 marks were measured, or these lie on one line.
    """
    measured, certified = np.asarray(measured, dtype=float), np.asarray(certified, dtype=float)
    if measured.ndim != 2 or measured.shape[1] != 2 or measured.shape != certified.shape:
        raise InputError(
            f"measured and certified marks have shapes {measured.shape} and {certified.shape}: both must be (n, 2), in "
            "the same order"
        )
    seen = np.isfinite(measured).all(axis=1)
    n = int(seen.sum())
    if n < LEAST_MARKS:
        raise InputError(f"{n} of the grating's {len(measured)} marks were measured: at least {LEAST_MARKS} are needed")
    to, start = measured[seen] - measured[seen].mean(axis=0), certified[seen] - certified[seen].mean(axis=0)
    if np.linalg.matrix_rank(start) < 2:
        raise InputError(f"the {n} marks that were measured lie on one line: measure marks of several rows")
    turn = np.vdot(_complex(start), _complex(to)) / np.sum(start**2)
    best = turn * _complex(start)
    deviations = np.full(measured.shape, np.nan)
    deviations[seen] = to - np.stack([best.real, best.imag], axis=-1)
    lengths = np.hypot(*deviations[seen].T)

    affine = np.linalg.lstsq(start, to, rcond=None)[0].T
    stretch_axes, stretches, turned_axes = np.linalg.svd(affine)
    stretch = stretch_axes * stretches @ stretch_axes.T  # P of M = P R
    variance = np.sum((to - start @ affine.T) ** 2) / (2 * n - 6)  # six parameters, the means among them
    places = start @ (stretch_axes @ turned_axes).T
    var_x, var_y = variance * np.diag(np.linalg.inv(places.T @ places))
    return MappingDeviation(
        n=n,
        of=len(measured),
        scale=float(np.abs(turn)),
        rotation=float(np.angle(turn)),
        deviations=deviations,
        largest=float(lengths.max()),
        rms=float(np.sqrt(np.mean(lengths**2))),
        alpha_x=float(stretch[0, 0]),
        alpha_y=float(stretch[1, 1]),
        squareness=float(_angle(*stretch.T) - np.pi / 2),
        alpha_x_sd=float(np.sqrt(var_x)),
        alpha_y_sd=float(np.sqrt(var_y)),
        squareness_sd=float(np.sqrt(var_x + var_y)),
    )


def in_plane(points: np.ndarray) -> np.ndarray:
    """Coordinates (n, 2) of marks (n, 3), some of them NaN, in their own best plane.

    The plane is turned into the horizontal the shortest way, and x and y are those of the turned points about the
    marks' mean.

    Raises
    ------
    InputError
        If fewer than 4 marks were measured or they lie on one line.
    """
    seen = np.isfinite(points).all(axis=1)
    return fit_plane(points[seen]).levelled(points)[:, :2]


def _complex(places: np.ndarray) -> np.ndarray:
    return places[:, 0] + 1j * places[:, 1]


def _angle(one: np.ndarray, other: np.ndarray) -> float:
    return float(np.arccos(one @ other / np.linalg.norm(one) / np.linalg.norm(other)))
