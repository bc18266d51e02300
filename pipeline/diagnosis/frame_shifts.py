"""What single frames do that others do not: a part that moves while they are taken, and light that flickers.

Of a frame whose light is 1 + g_n, whose fringes are shifted by ε_n, and on whose picture the part has moved by δ_n
px, all alike in all pixels, fringes leave over

    r_n = P [ g_n I_n - ε_n B sin(φ + θ_n) - δ_n · grad(ln A) I_n ],   I_n = A + B cos(φ + θ_n),

P being the projection onto what fringes and background cannot explain. All of g, ε and δ are estimated together by
least squares over the pixels, and fringes and they in turn, as in the advanced iterative algorithm (Wang and Han, Opt.
Lett. 29, 2004), here with gains and motion. What is common to all frames,
and what a set of so few cannot show, is left at zero. Harmonics of a bent response are alike in all frames, and are
subtracted before.
"""

from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from ..blas import on_one_thread
from .finding import FALSE_ALARM, Finding, Yardstick
from .response import measure_harmonics
from .sequence import FringeFit, Sequence, fit_fringes

MIN_FRAMES = 5
"""Of a set: four show half of their shifts only."""

_ITERATIONS = 3  # shifts are far below a step of the fringes
_VISIBLE = 1e-6  # of the largest eigenvalue of the information


@dataclass(frozen=True, eq=False)
class FrameErrors:
    """Of the frames of one set, about their means.

    Parameters
    ----------
    gains : (N,)
    shifts_rad : (N,)
    motion_px : (2, N)
        Along u and v.
    covariance : (4 N, 4 N)
        Of gains, shifts and motion, in this order.
    """

    gains: np.ndarray
    shifts_rad: np.ndarray
    motion_px: np.ndarray
    covariance: np.ndarray

    def significant(self, which: slice) -> bool:
        """Whether these of the 4 N figures differ from zero by more than noise."""
        values = np.concatenate([self.gains, self.shifts_rad, self.motion_px.ravel()])[which]
        size, axes = np.linalg.eigh(self.covariance[which, which])
        seen = size > _VISIBLE * size.max()
        squares = (axes.T @ values)[seen] ** 2 / size[seen]
        return bool(squares.sum() > chi2.isf(FALSE_ALARM, seen.sum()))


@on_one_thread
def frame_errors(fit: FringeFit, residual: np.ndarray, gradients: np.ndarray, grey_variance: np.ndarray) -> FrameErrors:
    """By least squares over all pixels.

    Parameters
    ----------
    fit : FringeFit
    residual : (N, pixels)
        What it leaves over, DN, freed from harmonics.
    gradients : (2, pixels)
        Relative change of the part's brightness per px along u and v.
    grey_variance : (pixels,)
        Of a grey value, DN²; what is left over counts instead where that is more.
    """
    n = len(fit.shifts)
    design = np.column_stack([np.ones(n), np.cos(fit.shifts), np.sin(fit.shifts)])
    projection = np.eye(n) - design @ np.linalg.pinv(design)
    derivatives = _derivatives(fit, gradients)
    weighted = derivatives / grey_variance
    information = np.einsum("anp,bmp->anbm", weighted, derivatives, optimize=True) * projection[:, None, :]
    information = information.reshape(4 * n, 4 * n)
    gradient = np.sum(weighted * residual, axis=-1).ravel()
    scale = np.sqrt(np.maximum(np.diag(information), 1e-30))  # the unknowns have different units
    size, axes = np.linalg.eigh(information / np.outer(scale, scale))
    seen = size > _VISIBLE * size.max()
    covariance = (axes[:, seen] / size[seen]) @ axes[:, seen].T / np.outer(scale, scale)
    values = covariance @ gradient
    freedom = max((n - 3) * residual.shape[1] - seen.sum(), 1)
    left_over = (np.sum(residual**2 / grey_variance) - values @ gradient) / freedom
    gains, shifts, *motion = values.reshape(4, n)
    return FrameErrors(gains, shifts, np.array(motion), covariance * max(left_over, 1.0))


def refined_errors(sequence: Sequence, k: int) -> FrameErrors:
    """Of the frames of the k-th set, estimated anew with fringes that were fitted with the shifts and gains before."""
    part = sequence.fringes.slices[k]
    grey, nominal = sequence.grey[part], sequence.shifts[part]
    gains, shifts, motion = np.ones(len(nominal)), np.zeros(len(nominal)), np.zeros((2, len(nominal)))
    for _ in range(_ITERATIONS):
        moved = 1 - np.tensordot(motion, sequence.brightness_gradients, axes=(0, 0))
        fit = fit_fringes(grey / (gains[:, None] * moved), nominal + shifts)
        harmonics = measure_harmonics(fit, sequence.grey_variance, sequence.fringes.periods[k])
        left = fit.residual - harmonics.light(fit)
        errors = frame_errors(fit, left, sequence.brightness_gradients, sequence.grey_variance)
        gains, shifts, motion = gains * (1 + errors.gains), shifts + errors.shifts_rad, motion + errors.motion_px
    return FrameErrors(gains - 1, shifts, motion, errors.covariance)


def check_frames(sequence: Sequence, yardstick: Yardstick) -> list[Finding]:
    """Vibration and flicker in the set that heights come from, if it has `MIN_FRAMES`; else in the one with most."""
    counts, periods = sequence.fringes.steps, sequence.fringes.periods
    k = len(counts) - 1 if counts[-1] >= MIN_FRAMES else int(np.argmax(counts))
    if counts[k] < MIN_FRAMES or len(sequence.pixels) == 0:
        return []
    fit, n = sequence.fits[k], counts[k]
    to_finest = periods[k] / periods[-1]
    gradients = sequence.brightness_gradients
    errors = refined_errors(sequence, k)
    by_gain, by_shift, *_ = _derivatives(fit, gradients)
    shift_sd = to_finest * _spread(errors.shifts_rad, np.diag(errors.covariance)[n : 2 * n])
    # Motion along the picture is let go: it acts where brightness changes, not on heights as a whole.
    # The frames' mean shift moves all heights and is not seen; it has its share of what the others have.
    ripple = to_finest * _phase_error(fit, by_shift * errors.shifts_rad[:, None])
    vibration = float(np.hypot(ripple, shift_sd / np.sqrt(n)))
    flicker = float(to_finest * _phase_error(fit, by_gain * errors.gains[:, None]))
    findings = []
    if vibration > yardstick.least_rad and errors.significant(slice(n, 2 * n)):
        evidence = {"shift_sd_rad": shift_sd, "motion_sd_px": float(np.std(errors.motion_px))}
        amplitude_um = yardstick.um(shift_sd)
        findings.append(
            Finding(
                name="vibration",
                where=sequence.where,
                effect_rad=vibration,
                effect_um=yardstick.um(vibration),
                cause="from frame to frame the part stands elsewhere: something moves while frames are taken",
                remedy="isolate the table, wait until the stage is at rest, or take more frames: the error falls with "
                "the square root of their number",
                evidence=evidence if amplitude_um is None else evidence | {"height_sd_um": amplitude_um},
            )
        )
    if flicker > yardstick.least_rad and errors.significant(slice(0, n)):
        findings.append(
            Finding(
                name="flicker",
                where=sequence.where,
                effect_rad=flicker,
                effect_um=yardstick.um(flicker),
                cause="the light changes from frame to frame",
                remedy="expose for whole periods of the lamp's supply or of the projector, or let it warm up",
                evidence={"gain_sd": _spread(errors.gains, np.diag(errors.covariance)[:n])},
            )
        )
    return findings


def _derivatives(fit: FringeFit, gradients: np.ndarray) -> np.ndarray:
    """Of the grey values by gain, shift and motion along u and v, (4, N, pixels) DN."""
    light = fit.background + fit.modulation * np.cos(fit.angles)
    return np.stack([light, -fit.modulation * np.sin(fit.angles), *(-each * light for each in gradients)])


def _spread(values: np.ndarray, variances: np.ndarray) -> float:
    """Standard deviation of values beyond their own."""
    return float(np.sqrt(max(np.var(values, ddof=1) - variances.mean(), 0.0)))


def _phase_error(fit: FringeFit, error_dn: np.ndarray) -> float:
    """Root mean square over the pixels of what (N, pixels) errors of grey do to the phase, less their mean, rad."""
    by_pixel = -2 / len(fit.shifts) * np.sum(np.sin(fit.angles) * error_dn, axis=0) / np.maximum(fit.modulation, 1e-9)
    return float(np.std(by_pixel))
