"""Local averages that follow slopes: a plane fitted around every pixel."""

from dataclasses import dataclass

import cv2
import numpy as np

_REACH = 4.0  # sigmas
_LEAST_DETERMINANT = 1e-6  # of the normal matrix, as a share of what even weights have


@dataclass(frozen=True, eq=False)
class LocalPlanes:
    """Planes that fit the surroundings of each pixel best, under a Gaussian times weights, and their value there.

    Unlike a weighted mean such a value is not drawn to the heavier side of a slope: a plane stays what it is under any
    weights. Where weights are even, and nothing is missing, it is the mean under the Gaussian.

    A value at the offset (x, y) px counts G w (a + b x + c y): the Gaussian G, its weight w, and what makes the sum of
    these factors 1 and both their first moments 0.

    Parameters
    ----------
    sigma_px : float
    weight : (rows, cols) float64
        At most 1.
    shares : (3, rows, cols) float64
        a, b and c of each pixel.
    determined : (rows, cols) bool
        Whether the surroundings of the pixel determine a plane.
    """

    sigma_px: float
    weight: np.ndarray
    shares: np.ndarray
    determined: np.ndarray

    @classmethod
    def under(cls, weight: np.ndarray, sigma_px: float) -> "LocalPlanes":
        """Planes under a Gaussian of ``sigma_px`` times ``weight`` (rows, cols): inverse variances, 0 where unknown."""
        weight = weight / max(float(weight.max()), np.finfo(float).tiny)
        w, wx, wy, wxx, wxy, wyy = _moments(weight, _gaussian(sigma_px), second=True)
        # Cramer's rule: the cofactors of the normal matrix's first row.
        shares = np.stack([wxx * wyy - wxy * wxy, wxy * wy - wx * wyy, wx * wxy - wxx * wy])
        determinant = w * shares[0] + wx * shares[1] + wy * shares[2]
        determined = determinant > _LEAST_DETERMINANT * sigma_px**4 * w**3
        shares /= np.where(determined, determinant, 1.0)
        return cls(sigma_px, weight, shares, determined)

    def fit(self, values: np.ndarray) -> np.ndarray:
        """What the planes through ``values`` are at each pixel, (rows, cols) float64.

        ``values`` are finite, also where their weight is 0; they themselves are returned where no plane is determined.
        """
        moments = _moments(self.weight * values, _gaussian(self.sigma_px), second=False)
        fitted = sum(share * moment for share, moment in zip(self.shares, moments, strict=True))
        return np.where(self.determined, fitted, values)

    def variance(self, variance: np.ndarray) -> np.ndarray:
        """Variance of the fitted values, (rows, cols), if the values have independent errors of ``variance``."""
        a, b, c = self.shares
        v, vx, vy, vxx, vxy, vyy = _moments(self.weight**2 * variance, _gaussian(self.sigma_px) ** 2, second=True)
        gathered = a * a * v + 2 * a * (b * vx + c * vy) + b * b * vxx + 2 * b * c * vxy + c * c * vyy
        return np.where(self.determined, gathered, variance)


def _gaussian(sigma_px: float) -> np.ndarray:
    """Of volume 1, (taps,); the middle one is its peak."""
    reach = int(np.ceil(_REACH * sigma_px))
    gaussian = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma_px) ** 2)
    return gaussian / gaussian.sum()


def _moments(image: np.ndarray, kernel: np.ndarray, second: bool) -> list[np.ndarray]:
    """Sums over the surroundings under kernel x kernel: of the image, times x and y px, and times xx, xy and yy."""
    reach = len(kernel) // 2
    x = np.arange(-reach, reach + 1)
    powers = [kernel, kernel * x, kernel * x * x]
    orders = [(0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2)]
    return [
        cv2.sepFilter2D(image, cv2.CV_64F, powers[along], powers[down], borderType=cv2.BORDER_CONSTANT)
        for along, down in orders[: None if second else 3]
    ]
