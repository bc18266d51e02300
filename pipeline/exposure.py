"""How long to expose, and several exposures merged into one where the scene spans more than the camera."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import inf

import numpy as np

from greenough.instrument.contract import CameraNoise, Frames, Rig
from greenough.instrument.errors import InputError
from greenough.instrument.frame_figures import BRIGHTEST_PERCENTILE

from .grey_variance import GreyVariance, camera_variance

_TOLERANCE = 0.05  # of the aimed grey value
_CLIPPED = 0.98  # of the full scale: brighter parts may have lost light
_LARGEST_STEP = 16.0
_DARK = 0.01  # of the full scale: the least that the longest exposure must reach
_ATTEMPTS = 12


@dataclass(frozen=True)
class Bracketed:
    """Several exposures of one sequence, merged.

    Parameters
    ----------
    frames : Frames
        ``stack`` is (frames, rows, cols) float32 in DN of the longest exposure, black level 0, infinite where every
        exposure is saturated. The other fields are those of the longest exposure.
    variance : GreyVariance
        Of the grey values of ``frames``, (rows, cols) float32 each; `decode` takes it as its noise. Infinite where
        every exposure is saturated.
    saturated : (rows, cols) bool
        Where every exposure is saturated.
    """

    frames: Frames
    variance: GreyVariance
    saturated: np.ndarray


def auto_exposure(rig: Rig) -> float:
    """Set the camera's exposure so that the brightest part that counts reaches ``procedure.exposure_share``.

    A white pattern is projected, as bright as any fringe; the ``BRIGHTEST_PERCENTILE`` of the whole image above the
    black level is brought to that share of the full scale: the range of grey values above black or the full well,
    whichever is less. The longest exposure is kept if the part stays darker than that, and the only one where the
    camera has no other.

    Returns
    -------
    float
        The exposure that was set, µs.

    Raises
    ------
    InputError
        If the image is saturated at the shortest exposure, or dark at the longest.
    """
    camera = rig.camera
    shortest, longest = camera.exposure_limits_us
    if shortest == longest:
        return camera.exposure_us  # there is nothing to set; decoding leaves out what is saturated or dark
    full_scale = camera.full_scale_dn - camera.black_level_dn
    if camera.noise is not None:
        full_scale = min(full_scale, camera.noise.full_well_e / camera.noise.electrons_per_dn)
    aim = rig.procedure.exposure_share * full_scale
    white = np.full((1, *rig.projector.shape), 255, dtype=np.uint8)

    for _ in range(_ATTEMPTS):
        exposure = camera.exposure_us
        brightest = float(np.percentile(rig.capture(white).stack, BRIGHTEST_PERCENTILE)) - camera.black_level_dn
        clipped = brightest >= _CLIPPED * full_scale
        if not clipped and abs(brightest / aim - 1) <= _TOLERANCE:
            return exposure
        if exposure <= shortest and clipped:
            raise InputError(
                f"auto-exposure: the image is saturated at the shortest exposure of {shortest:g} µs; "
                "dim the projector's light"
            )
        if exposure <= shortest and brightest > aim:
            return exposure
        if exposure >= longest and brightest < aim:
            if brightest < _DARK * full_scale:
                raise InputError(
                    f"auto-exposure: the image is dark at the longest exposure of {longest:g} µs "
                    f"({brightest:.3g} DN above black, at least {_DARK * full_scale:.3g} needed); "
                    "check the light and that a part lies in the field"
                )
            return exposure
        step = 1 / _LARGEST_STEP if clipped else aim / max(brightest, aim / _LARGEST_STEP)
        camera.exposure_us = float(np.clip(exposure * step, shortest, longest))
    raise InputError(
        f"auto-exposure: the light did not settle within {_ATTEMPTS} images; it varies by more than "
        f"{_TOLERANCE:.0%} from image to image, so steady it"
    )


def capture_bracketed(rig: Rig, patterns: np.ndarray, ratios: Sequence[float]) -> Bracketed:
    """Capture one sequence at several exposures and merge them.

    Parameters
    ----------
    rig : Rig
        Its present exposure has ratio 1, and is set again afterwards.
    patterns : (frames, rows, cols) uint8
        What is projected.
    ratios : sequence of float
        Exposures as multiples of the present one.

    Raises
    ------
    InputError
        If an exposure lies outside the camera's limits; nothing has been captured then.
    """
    camera, noise = rig.camera, rig.camera.noise
    present = camera.exposure_us
    shortest, longest = camera.exposure_limits_us
    for ratio in ratios:
        if not shortest <= present * ratio <= longest:
            raise InputError(
                f"bracketing: {ratio:g} times the exposure of {present:g} µs lies outside the camera's limits of "
                f"{shortest:g} to {longest:g} µs; choose another ratio in procedure.brackets"
            )
    if noise is None:
        raise InputError("bracketing: exposures are weighted by the camera's data sheet, which this rig does not state")
    sequences = []
    try:
        for ratio in ratios:
            camera.exposure_us = present * ratio
            sequences.append(rig.capture(patterns))
    finally:
        camera.exposure_us = present
    return merge(sequences, noise)


def merge(sequences: Sequence[Frames], noise: CameraNoise) -> Bracketed:
    """Merge exposures of the same sequence, pixel by pixel, each weighted by the inverse of its variance.

    An exposure counts at a pixel only if none of its frames is saturated there, so that all frames of a pixel have the
    same weights: the variance at their mean (`grey_variance.camera_variance`) decides. The variance of a pixel's merged
    grey values therefore remains an affine function of the light.

    Parameters
    ----------
    sequences : sequence of Frames
        The same patterns at different exposures, in any order.
    noise : CameraNoise
        The camera's data sheet.
    """
    longest = max(sequences, key=lambda frames: frames.exposure_us)
    shape = longest.stack.shape
    total = np.zeros(shape, dtype=np.float32)
    total_weight, at_black, per_dn = (np.zeros(shape[1:], dtype=np.float32) for _ in range(3))
    for frames in sequences:
        scale = longest.exposure_us / frames.exposure_us
        single = camera_variance(noise, quantised=frames.stack.dtype.kind == "u")
        background = frames.stack.mean(axis=0, dtype=np.float32) - frames.black_level_dn
        clipped = frames.stack.max(axis=0) >= frames.full_scale_dn
        weight = np.where(clipped, 0, 1 / (scale**2 * single.at(background))).astype(np.float32)
        total_weight += weight
        weight *= scale  # of the grey value as it was exposed
        at_black += weight**2 * single.at_black_dn2
        per_dn += weight**2 / scale * single.per_dn  # for each DN of the longest exposure
        for grey, merged in zip(frames.stack, total, strict=True):
            merged += weight * (grey - np.float32(frames.black_level_dn))

    saturated = total_weight == 0
    total_weight[saturated] = 1
    for merged in total:
        merged /= total_weight
        merged[saturated] = inf
    at_black /= total_weight**2
    per_dn /= total_weight**2
    at_black[saturated] = inf
    return Bracketed(
        frames=replace(longest, stack=total, black_level_dn=0.0, full_scale_dn=inf),
        variance=GreyVariance(at_black, per_dn),
        saturated=saturated,
    )
