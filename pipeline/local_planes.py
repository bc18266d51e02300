"""Local averages that follow slopes: a plane fitted around every pixel."""

import cv2
import numpy as np

_REACH = 4.0  # sigmas


def fit_local_planes(values: np.ndarray, weight: np.ndarray, sigma_px: float) -> np.ndarray:
    """Value at each pixel of the plane that fits its surroundings best, under a Gaussian of ``sigma_px`` times weights.

    Unlike a weighted mean it is not drawn to the heavier side of a slope: a plane stays what it is under any weights.

    Parameters
    ----------
    values : (rows, cols)
        Finite, also where the weight is 0.
    weight : (rows, cols)
        Inverse variances, 0 where unknown.
    sigma_px : float

    Returns
    -------
    (rows, cols) float64
        ``values`` themselves where the surroundings determine no plane.
    """
    reach = int(np.ceil(_REACH * sigma_px))
    x = np.arange(-reach, reach + 1) / sigma_px
    gaussian = np.exp(-0.5 * x * x)
    gaussian /= gaussian.sum()
    powers = [gaussian, gaussian * x, gaussian * x * x]

    def moment(image: np.ndarray, along_row: int, along_column: int) -> np.ndarray:
        return cv2.sepFilter2D(
            image, cv2.CV_64F, powers[along_row], powers[along_column], borderType=cv2.BORDER_CONSTANT
        )

    weight = weight / max(float(weight.max()), np.finfo(float).tiny)
    w, wx, wy = moment(weight, 0, 0), moment(weight, 1, 0), moment(weight, 0, 1)
    wxx, wxy, wyy = moment(weight, 2, 0), moment(weight, 1, 1), moment(weight, 0, 2)
    weighted = weight * values
    f, fx, fy = moment(weighted, 0, 0), moment(weighted, 1, 0), moment(weighted, 0, 1)
    # Cramer's rule for the constant of c + a x + b y: the cofactors of the normal matrix's first row.
    first, second, third = wxx * wyy - wxy * wxy, wxy * wy - wx * wyy, wx * wxy - wxx * wy
    determinant = w * first + wx * second + wy * third
    determined = determinant > 1e-6 * w**3  # 1 for even weights
    return np.where(determined, (f * first + fx * second + fy * third) / np.where(determined, determinant, 1.0), values)
