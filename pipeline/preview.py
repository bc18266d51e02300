"""How a part looks before it is measured: a few frames tell what will saturate and what will stay too dark."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from greenough.instrument.contract import CameraNoise, Placement, Rig
from greenough.instrument.files import atomic_path
from greenough.instrument.frame_figures import BRIGHTEST_PERCENTILE, fringe_patterns, modulation_maps
from greenough.instrument.packets import packed

from .acquisition import capture_part
from .fringes import FringeSet
from .grey_variance import GreyVariance, camera_variance, estimate_variance
from .jit import Float
from .unwrap import is_modulated, order_is_safe

_STEPS = 4
_SATURATED_COLOUR, _WEAK_COLOUR = (0.84, 0.15, 0.12), (0.16, 0.38, 0.85)
_WEAK_ON_BLACK = (0.11, 0.27, 0.6)  # the same where the picture is black
_TINT = 0.7  # share of the colour where light is too weak; the rest is the picture
_WIDTH_IN, _DPI = 13.0, 120


@dataclass(frozen=True, eq=False)
class Preview:
    """What a few frames say about a part. All arrays are (rows, cols).

    Parameters
    ----------
    light : float32
        The picture under even light, DN above black; of saturated pixels what is left of it.
    fringes : float32
        One frame of the densest fringes, likewise.
    modulation : float32
        Modulation of the densest fringes, DN.
    saturated : bool
        Where even light, as bright as the brightest fringe, clips in every exposure. Fringes clip somewhat less.
    weak : bool
        Where it does not, but the densest fringes are too faint for a safe fringe order: dark, blurred or outshone.
    exposure_us : float
        The longest exposure.
    """

    light: np.ndarray
    fringes: np.ndarray
    modulation: np.ndarray
    saturated: np.ndarray
    weak: np.ndarray
    exposure_us: float

    @property
    def measurable(self) -> np.ndarray:
        """Where a measurement can be expected, (rows, cols) bool."""
        return ~(self.saturated | self.weak)


def preview(rig: Rig, placement: Placement, fringes: FringeSet, brackets: Sequence[float] = (1.0,)) -> Preview:
    """Look at a part as `acquisition.measure` would, in five frames: white, and the densest fringes in four steps.

    No calibration is needed, and nothing is decoded. The modulation of the densest fringes stands for that of all,
    which is no less. What decoding finds out from more frames is not foreseen: light that comes from other parts of
    the specimen, and orders that the wrap of the coarsest fringes leaves open.

    Parameters
    ----------
    rig : Rig
        Open.
    placement : Placement
    fringes : FringeSet
        What it will be measured with.
    brackets : sequence of float
        As for `acquisition.measure`.

    Raises
    ------
    InputError
        If the part or its exposure is refused.
    """
    white = np.full((1, *rig.projector.shape), 255, dtype=np.uint8)
    patterns = np.concatenate([white, fringe_patterns(rig.projector.shape, fringes.periods[-1], _STEPS)])
    frames, noise = capture_part(rig, placement, patterns, brackets)
    saturated = frames.stack.max(axis=0) >= frames.full_scale_dn
    stack = np.where(np.isfinite(frames.stack), frames.stack, 0).astype(np.float32)  # merged ones are infinite there
    modulation, mean = modulation_maps(stack[1:], frames.black_level_dn)
    if noise is None:
        shown = FringeSet((fringes.periods[-1],), (_STEPS,), field=rig.projector.shape[1])
        noise = estimate_variance(frames.stack[1:], shown, frames.black_level_dn, frames.full_scale_dn)
    if isinstance(noise, CameraNoise):
        noise = camera_variance(noise, quantised=frames.stack.dtype.kind == "u")
    weak = ~saturated & ~_is_enough(modulation, mean, noise, fringes)
    light, one = (frame - np.float32(frames.black_level_dn) for frame in stack[:2])
    return Preview(light, one, modulation, saturated, weak, frames.exposure_us)


def _is_enough(modulation: np.ndarray, mean: np.ndarray, noise: GreyVariance, fringes: FringeSet) -> np.ndarray:
    """Where fringes of this modulation and mean, (rows, cols) DN, can be decoded, (rows, cols) bool."""
    variance = np.where(np.isfinite(noise.at_black_dn2), noise.at(mean), 1)
    # Noise V of four frames makes a modulation of the mean square V, which does not count.
    squared = np.maximum(np.square(modulation) - 4 / _STEPS * variance, 1e-20)
    of_sets = [Float(packed((2 / steps * variance / squared).astype(np.float32))) for steps in fringes.steps]
    safe = order_is_safe(of_sets, fringes) if fringes.spans_field else is_modulated(of_sets)
    return safe.numpy().reshape(mean.shape)


def write_preview(path: str | Path, seen: Preview, title: str) -> None:
    """Draw what was seen as PNG: the picture with marks, and fringes. The file appears whole or not at all."""
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch

    rows, cols = seen.light.shape
    white = max(float(np.percentile(seen.light, BRIGHTEST_PERCENTILE)), 1.0)
    grey = np.clip(seen.light / white, 0, 1)[..., None].repeat(3, axis=-1)
    grey[seen.weak] = (1 - _TINT) * grey[seen.weak] + _TINT * np.array(_WEAK_COLOUR)
    grey[seen.saturated] = _SATURATED_COLOUR
    figure = Figure(figsize=(_WIDTH_IN, 0.45 * _WIDTH_IN * rows / cols + 1.4), dpi=_DPI, layout="constrained")
    figure.suptitle(title, parse_math=False)
    marked, fringes = figure.subplots(1, 2)
    marked.imshow(grey)
    marked.set_title(f"even light, {seen.exposure_us / 1e3:.4g} ms; measurable {seen.measurable.mean():.1%} of pixels")
    fringes.imshow(seen.fringes, cmap="gray", vmin=0, vmax=white)
    contrast = np.median(seen.modulation[seen.measurable]) if seen.measurable.any() else 0.0
    fringes.set_title(f"densest fringes; median modulation {contrast:.3g} DN where measurable")
    for axes in (marked, fringes):
        axes.set_xlabel("column, px")
        axes.set_ylabel("row, px")
    marks = [
        Patch(color=_SATURATED_COLOUR, label=f"saturated {seen.saturated.mean():.1%}"),
        Patch(
            color=_WEAK_ON_BLACK,
            label=f"too dark, or fringes too faint {seen.weak.mean():.1%}",
        ),
    ]
    figure.legend(handles=marks, loc="outside lower center", ncols=2, frameon=False)
    with atomic_path(path) as temporary:
        figure.savefig(temporary)
