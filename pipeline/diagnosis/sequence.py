"""One captured fringe sequence, a sample of its pixels, and fringes fitted to them by least squares."""

from collections.abc import Sequence as Many
from dataclasses import dataclass
from functools import cached_property
from math import inf

import cv2
import numpy as np

from greenough.instrument.contract import CameraNoise, Frames
from greenough.instrument.errors import InputError

from ..blas import on_one_thread
from ..decode import PhaseMap, decode
from ..fringes import FringeSet
from ..grey_variance import GreyVariance, camera_variance, estimate_variance
from ..jit import Float
from ..order_search import check_orders
from ..unwrap import is_modulated, order_is_safe

SAMPLE_PIXELS = 4_000
_CHANGES = 5.0  # standard deviations by which grey must change over the frames where fringes are seen
_SMOOTHED_PX = 1.0  # before the brightness is differentiated


@dataclass(frozen=True, eq=False)
class FringeFit:
    """Fringes A + B cos(φ + θ_n) of one set in each pixel.

    Parameters
    ----------
    shifts : (N,)
        θ_n, rad.
    background, modulation, phase : (pixels,)
        A and B above black in DN, φ in rad.
    residual : (N, pixels)
        Measured minus fitted, DN.
    """

    shifts: np.ndarray
    background: np.ndarray
    modulation: np.ndarray
    phase: np.ndarray
    residual: np.ndarray

    @property
    def angles(self) -> np.ndarray:
        """φ + θ_n, (N, pixels)."""
        return self.phase + self.shifts[:, None]


@on_one_thread
def fit_fringes(grey: np.ndarray, shifts: np.ndarray) -> FringeFit:
    """Least squares of (N, pixels) grey values that were shifted by ``shifts`` (N,) rad, in any order."""
    design = np.column_stack([np.ones(len(shifts)), np.cos(shifts), -np.sin(shifts)])
    background, cosine, sine = fitted = np.linalg.pinv(design) @ grey
    return FringeFit(shifts, background, np.hypot(cosine, sine), np.arctan2(sine, cosine), grey - design @ fitted)


@dataclass(frozen=True, eq=False)
class Sequence:
    """Frames of one fringe set.

    Parameters
    ----------
    where : str
        What to call it.
    frames : Frames
        In the order of the patterns, as far as anybody knows.
    fringes : FringeSet
    variance : GreyVariance
        Of a grey value.
    quiet : bool
        Whether what was captured has one height and brightness nearly everywhere: fringes then differ over the
        picture by the optics alone.
    """

    where: str
    frames: Frames
    fringes: FringeSet
    variance: GreyVariance
    quiet: bool = False

    @cached_property
    def saturated(self) -> np.ndarray:
        """(rows, cols) bool: some frame is at full scale."""
        return np.any(self.frames.stack >= self.frames.full_scale_dn, axis=0)

    @cached_property
    def brightness(self) -> np.ndarray:
        """Mean of all frames above black, (rows, cols) float32 DN."""
        return self.frames.stack.mean(axis=0, dtype=np.float32) - np.float32(self.frames.black_level_dn)

    @cached_property
    def fringed(self) -> np.ndarray:
        """(rows, cols) bool: grey changes from frame to frame by more than noise, whatever their order."""
        spread = self.frames.stack.std(axis=0, dtype=np.float32)
        return spread > _CHANGES * np.sqrt(self.variance.at(self.brightness))

    @cached_property
    def pixels(self) -> np.ndarray:
        """Indices (n,) of a regular sample of fringed pixels that are not saturated, in the flattened picture."""
        sound = np.flatnonzero(self.fringed & ~self.saturated)
        return sound[:: max(1, len(sound) // SAMPLE_PIXELS)]

    @cached_property
    def grey(self) -> np.ndarray:
        """Grey values of the sample above black, (frames, n) float64."""
        stack = self.frames.stack.reshape(len(self.frames.stack), -1)
        return stack[:, self.pixels].astype(float) - self.frames.black_level_dn

    @cached_property
    def grey_variance(self) -> np.ndarray:
        """Variance of a grey value as bright as the background in each pixel of the sample, (n,) DN²."""
        return self.variance.at(self.grey.mean(axis=0))

    @cached_property
    def brightness_gradients(self) -> np.ndarray:
        """Relative change of the brightness per px along u and v at the sample, (2, n)."""
        logarithm = np.log(np.maximum(cv2.GaussianBlur(self.brightness, (0, 0), _SMOOTHED_PX), 1.0))
        return np.stack([each.ravel()[self.pixels] for each in np.gradient(logarithm)[::-1]]).astype(float)

    @property
    def shifts(self) -> np.ndarray:
        """Phase step of each frame, (frames,) rad."""
        return np.concatenate([self.fringes.sign * 2 * np.pi * np.arange(n) / n for n in self.fringes.steps])

    @cached_property
    def fits(self) -> Many[FringeFit]:
        """Of each set in the sample."""
        return [fit_fringes(self.grey[part], self.shifts[part]) for part in self.fringes.slices]

    @cached_property
    def sigma_rad(self) -> float:
        """Median standard deviation of the finest phase by noise."""
        fit = self.fits[-1]
        return float(np.median(np.sqrt(2 / len(fit.shifts) * self.grey_variance) / np.maximum(fit.modulation, 1e-9)))

    @cached_property
    def modulations(self) -> np.ndarray:
        """Modulation of each set, (sets, rows, cols) float32 DN."""
        maps = []
        for part in self.fringes.slices:
            shifts = self.shifts[part].astype(np.float32)
            turned = (np.tensordot(turn(shifts), self.frames.stack[part], axes=1) for turn in (np.cos, np.sin))
            maps.append(2 / len(shifts) * np.hypot(*turned))
        return np.array(maps)

    @cached_property
    def orders_safe(self) -> np.ndarray:
        """(rows, cols) bool: noise alone turns a fringe order less often than the decoder accepts."""
        variance = self.variance.at(self.brightness).ravel()
        variances = [
            Float((2 / n * variance / np.maximum(own.ravel(), 1e-6) ** 2).astype(np.float32))
            for n, own in zip(self.fringes.steps, self.modulations, strict=True)
        ]
        safe = order_is_safe(variances, self.fringes) if self.fringes.spans_field else is_modulated(variances)
        return safe.numpy().reshape(self.brightness.shape)

    @cached_property
    def tells_orders(self) -> bool:
        """Whether these sets tell fringe orders by themselves; a Gray code beside them may be what does."""
        if self.fringes.spans_field:
            return True
        try:
            check_orders(self.fringes, None)
        except InputError:
            return False
        return True

    @cached_property
    def decoded(self) -> PhaseMap:
        """Its phase map."""
        return decode(self.frames, self.fringes, self.variance)


def sequence_of(
    where: str, frames: Frames | np.ndarray, fringes: FringeSet, noise: CameraNoise | None = None, quiet: bool = False
) -> Sequence:
    """Frames, or a bare stack of them, with the noise of a data sheet or, without one, as the frames show it."""
    if not isinstance(frames, Frames):
        stack = np.asarray(frames)
        full_scale = float(np.iinfo(stack.dtype).max) if stack.dtype.kind == "u" else inf
        counted = np.arange(len(stack))
        frames = Frames(stack, full_scale, 0.0, 0.0, 0.0, 0.0, counted, counted.astype(float))
    if noise is None:
        variance = estimate_variance(frames.stack, fringes, frames.black_level_dn, frames.full_scale_dn)
    else:
        variance = camera_variance(noise, quantised=frames.stack.dtype.kind == "u")
    return Sequence(where, frames, fringes, variance, quiet)
