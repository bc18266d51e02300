"""Where fringes are sharp: contrast of the finest set over that of the widest, over the picture and over heights.

Brightness cancels in this ratio; what is left is what blur takes from the finest fringes. Out of focus by z a cone of
rays of aperture NA is a disc of the radius NA z, which leaves the contrast 1 - (π NA z / p)² / 2 of a fringe with the
period p at the specimen: a parabola in z for each path, whose vertex is the focus. Noise goes with 1 / contrast.
"""

import numpy as np
from scipy.stats import t as student

from ..blas import on_one_thread
from .finding import FALSE_ALARM, Finding, Yardstick
from .sequence import Sequence

LEAST_LOSS = 0.05
"""Of noise that is added by defocus: acceptance judges noise to five hundredths of what is predicted."""

LEAST_LOCAL_LOSS = 0.2
"""The same within one picture of a level part, where curved fields have their share."""

MIN_HEIGHTS = 6

_BLOCKS = 20  # across the picture
_MIN_FILL = 0.75


def contrast_map(sequence: Sequence) -> np.ndarray:
    """Modulation of the finest over the widest set, (grid rows, grid cols), 20 blocks across the picture.

    NaN where three quarters of the pixels do not show fringes.
    """
    side = max(1, sequence.brightness.shape[1] // _BLOCKS)
    sound = sequence.fringed & ~sequence.saturated
    fine, wide, count = (
        _block_sums(np.where(sound, each, 0.0), side)
        for each in (sequence.modulations[-1], sequence.modulations[0], np.ones_like(sequence.brightness))
    )
    return np.where(count >= _MIN_FILL * side**2, fine / np.maximum(wide, 1e-9), np.nan)


def check_focus_map(sequence: Sequence, yardstick: Yardstick) -> list[Finding]:
    """Parts of a level scene that are blurred against its sharpest tenth."""
    if not sequence.quiet or len(sequence.fringes.periods) < 2 or len(sequence.pixels) == 0:
        return []
    contrast = contrast_map(sequence)
    if not np.isfinite(contrast).any():
        return []
    sharp = float(np.nanpercentile(contrast, 90))
    added = float(np.nanmean(sharp / np.maximum(contrast, 1e-3))) - 1
    effect = sequence.sigma_rad * added
    if added < LEAST_LOCAL_LOSS:
        return []
    row, col = np.unravel_index(np.nanargmin(contrast), contrast.shape)
    rows, cols = contrast.shape
    worst = f"{_side(int(row), rows, 'top', 'bottom')} {_side(int(col), cols, 'left', 'right')}"
    return [
        Finding(
            name="defocus",
            where=f"{sequence.where}, worst {worst}",
            effect_rad=effect,
            effect_um=yardstick.um(effect),
            cause="fine fringes are blurred in parts of the picture: these lie out of focus",
            remedy="level the part, or focus both paths on its middle",
            evidence={
                "noise_added_share": added,
                "lowest_contrast": float(np.nanmin(contrast)),
                "sharp_contrast": sharp,
            },
        )
    ]


@on_one_thread
def check_focus_range(
    heights_mm: np.ndarray, contrasts: np.ndarray, sigma_rad: float, where: str, yardstick: Yardstick
) -> list[Finding]:
    """Whether the focus lies in the middle of the heights that were passed through.

    Parameters
    ----------
    heights_mm, contrasts : (n,)
        Of a level face at n heights: mean of `contrast_map`.
    sigma_rad : float
        Noise of a phase in the middle.
    """
    if len(heights_mm) < MIN_HEIGHTS:
        return []
    middle, half = (heights_mm.max() + heights_mm.min()) / 2, np.ptp(heights_mm) / 2
    z = (heights_mm - middle) / half
    design = np.column_stack([np.ones_like(z), z, z**2])
    inverse = np.linalg.inv(design.T @ design)
    fitted = inverse @ design.T @ np.log(contrasts)
    freedom = len(z) - 3
    variance = np.sum((np.log(contrasts) - design @ fitted) ** 2) / freedom * inverse
    tilt = fitted[1]
    # From the middle to the worse end contrast falls by |tilt| more than if the focus were in the middle.
    added = float(np.expm1(abs(tilt)))
    if added < LEAST_LOSS or abs(tilt) < student.isf(FALSE_ALARM / 2, freedom) * np.sqrt(variance[1, 1]):
        return []
    effect = sigma_rad * added
    focus = middle - half * tilt / (2 * fitted[2]) if fitted[2] < 0 else np.copysign(np.inf, tilt)
    end = "lower" if tilt > 0 else "upper"
    off = abs(focus - middle)
    return [
        Finding(
            name="defocus",
            where=where,
            effect_rad=effect,
            effect_um=yardstick.um(effect),
            cause=f"fringes are sharpest {off:.2g} mm {'above' if tilt > 0 else 'below'} the middle of the heights: at "
            f"the {end} end they are blurred, and noise is {100 * added:.0f} % more than it need be",
            remedy=f"focus both paths on the middle, or move the range by {off:.2g} mm",
            evidence={"focus_off_mm": float(focus - middle), "noise_added_share": added},
        )
    ]


def _block_sums(image: np.ndarray, side: int) -> np.ndarray:
    rows, cols = (n // side for n in image.shape)
    return image[: rows * side, : cols * side].reshape(rows, side, cols, side).sum(axis=(1, 3), dtype=float)


def _side(index: int, count: int, low: str, high: str) -> str:
    return low if index < count / 3 else high if index >= 2 * count / 3 else "middle"
