"""Too much light, too little, and light that carries no fringes."""

import cv2
import numpy as np

from greenough.instrument.frame_figures import BRIGHTEST_PERCENTILE, LIT

from .finding import Finding, Yardstick
from .sequence import Sequence

LEAST_SHARE = 1e-3
"""Of the pixels with fringes that must be lost before a word is said: as many are at the rims of any part."""

_LEAST_PATCH_PX = 9  # saturated pixels that touch: fewer are the sensor's own
_AIM = 0.8  # of the full scale, for the brightest part
_STOP = 2.0  # by which light must be missing
_WEAK_SHARE = 0.05  # of the lit pixels


def check_saturation(sequence: Sequence, yardstick: Yardstick) -> list[Finding]:
    """Patches of pixels that are at full scale in some frame.

    Noise alone does not bring a pixel there that was exposed to less than nine tenths of it, and defects of the sensor
    are single.
    """
    saturated = sequence.saturated.astype(np.uint8)
    _, _, patches, _ = cv2.connectedComponentsWithStats(saturated, connectivity=8)
    areas = patches[1:, cv2.CC_STAT_AREA]
    areas = areas[areas >= _LEAST_PATCH_PX]
    seen = int((sequence.fringed | sequence.saturated).sum())
    if len(areas) == 0 or areas.sum() < LEAST_SHARE * seen:
        return []
    share = float(areas.sum() / seen)
    effect = _of_lost(share)
    return [
        Finding(
            name="saturation",
            where=sequence.where,
            effect_rad=effect,
            effect_um=yardstick.um(effect),
            cause="parts of the picture are brighter than the camera can count: no height is given there",
            remedy="expose for a shorter time, merge exposures (measure --bracket), or turn a shiny part a little",
            evidence={"saturated_share": share, "largest_patch_px": float(areas.max())},
        )
    ]


def check_light(sequence: Sequence, yardstick: Yardstick) -> list[Finding]:
    """Too short an exposure, light that no fringes modulate, and parts where they are too weak to be counted."""
    if len(sequence.pixels) == 0:
        return [
            Finding(
                name="no fringes",
                where=sequence.where,
                effect_rad=2 * np.pi,
                effect_um=yardstick.um(2 * np.pi),
                cause="no pixel changes from frame to frame by more than noise",
                remedy="check that the projector runs, that the part lies in its light, and how long is exposed",
                evidence={"largest_grey_dn": float(sequence.brightness.max())},
            )
        ]
    return [*_dim(sequence, yardstick), *_flat(sequence, yardstick), *_weak(sequence, yardstick)]


def _dim(sequence: Sequence, yardstick: Yardstick) -> list[Finding]:
    frames, fit = sequence.frames, sequence.fits[-1]
    brightest = float(np.percentile(frames.stack.max(axis=0), BRIGHTEST_PERCENTILE)) - frames.black_level_dn
    longer = _AIM * (frames.full_scale_dn - frames.black_level_dn) / max(brightest, 1e-9)
    if not _STOP < longer < np.inf:
        return []
    light = fit.background
    gain = np.median(1 - np.sqrt(sequence.variance.at(longer * light) / sequence.variance.at(light)) / longer)
    effect = float(sequence.sigma_rad * gain)
    if effect < yardstick.least_rad:
        return []
    return [
        Finding(
            name="too little light",
            where=sequence.where,
            effect_rad=effect,
            effect_um=yardstick.um(effect),
            cause="the brightest part is far below full scale, so that noise is larger than it need be",
            remedy=f"expose {longer:.2g} times as long, or open the light",
            evidence={"brightest_share": _AIM / longer, "noise_rad": sequence.sigma_rad},
        )
    ]


def _flat(sequence: Sequence, yardstick: Yardstick) -> list[Finding]:
    """Light under the widest fringes, which no blur flattens, costs noise."""
    fit = sequence.fits[0]
    contrast = float(np.median(fit.modulation / np.maximum(fit.background, 1e-9)))
    if contrast >= 1:
        return []
    with_it, without = sequence.variance.at(fit.background), sequence.variance.at(fit.modulation)
    effect = float(sequence.sigma_rad * np.median(1 - np.sqrt(without / with_it)))
    if effect < yardstick.least_rad:
        return []
    return [
        Finding(
            name="low contrast",
            where=sequence.where,
            effect_rad=effect,
            effect_um=yardstick.um(effect),
            cause="much of the light is not modulated: ambient light, a wrong black level, or weak patterns",
            remedy="shade the part, use patterns from black to white, and check the camera's black level",
            evidence={"contrast": contrast, "noise_rad": sequence.sigma_rad},
        )
    ]


def _weak(sequence: Sequence, yardstick: Yardstick) -> list[Finding]:
    lit = sequence.brightness > LIT * np.percentile(sequence.brightness, BRIGHTEST_PERCENTILE)
    lit &= ~sequence.saturated
    weak = lit & ~sequence.orders_safe
    share = float(weak.sum() / max(lit.sum(), 1))
    if share < _WEAK_SHARE:
        return []
    effect = _of_lost(share)
    return [
        Finding(
            name="low modulation",
            where=sequence.where,
            effect_rad=effect,
            effect_um=yardstick.um(effect),
            cause="lit parts show fringes so weak that noise could turn their order",
            remedy="focus both paths, expose longer, dull a shiny part, or use longer periods",
            evidence={"weak_share": share},
        )
    ]


def _of_lost(share: float) -> float:
    """Root mean square error where such a share of pixels is lost, each counted as a whole fringe off, rad."""
    return float(2 * np.pi * np.sqrt(share))
