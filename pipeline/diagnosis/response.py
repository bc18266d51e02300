"""The projector's response from the fringes: harmonics, the gamma that they speak of, and what a correction gains.

A pattern's grey v = (1 + cos ψ) / 2 that is shown as the light v^γ has the harmonics

    h_k = B_k / B_1 = Π_(j=1)^(k-1) (γ - j) / (γ + 1 + j),

so that the second one alone tells γ = (1 + 2 h_2) / (1 - h_2). cos kψ being the Chebyshev polynomial T_k(2v - 1), the
harmonics are the response curve itself: f(v) = Σ h_k T_k(2v - 1). Blur lowers harmonics of fine fringes more than of
wide ones; they are taken from the widest set that shows them.
"""

from collections.abc import Sequence as Many
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import chebyshev
from scipy.optimize import root_scalar
from scipy.stats import norm

from ..blas import on_one_thread
from ..grey_variance import QUANTISATION_VARIANCE
from .finding import FALSE_ALARM, Finding, Yardstick
from .sequence import FringeFit, Sequence, fit_fringes

MIN_FRAMES = 4
"""Of a set that shows a second harmonic."""

_GAMMAS = 0.2, 5.0  # between which an exponent is looked for
_LEAST_SHARE = 0.5  # of the largest modulation's median that a set must have to speak


@dataclass(frozen=True, eq=False)
class Harmonics:
    """Of the fringes of one set.

    Parameters
    ----------
    period_px : float
    steps : int
    ratios : (K,)
        B_k / B_1 for k = 2, 3, ...: the part that is in phase with the fringes, as a response makes it.
    sigma : (K,)
        Their standard deviations.
    """

    period_px: float
    steps: int
    ratios: np.ndarray
    sigma: np.ndarray

    @property
    def gamma(self) -> float:
        """Exponent of the power law with this second harmonic.

        What sets of few steps show for it is not quite h_2, see `_seen_second`.
        """
        second = float(self.ratios[0])

        def excess(gamma: float) -> float:
            _, h_2, h_3 = power_harmonics(gamma, 3)
            return _seen_second(h_2, h_3, self.steps) - second

        if not excess(_GAMMAS[0]) < 0 < excess(_GAMMAS[1]):
            return _gamma(second)
        return float(root_scalar(excess, bracket=_GAMMAS).root)

    def light(self, fit: FringeFit) -> np.ndarray:
        """What the harmonics add to the fringes that were fitted, (N, pixels) DN."""
        orders = range(2, 2 + len(self.ratios))
        return sum(
            (ratio * fit.modulation * np.cos(k * fit.angles) for k, ratio in zip(orders, self.ratios, strict=True)),
            np.zeros_like(fit.residual),
        )

    def curve(self, grey: np.ndarray) -> np.ndarray:
        """Light for patterns' grey values from 0 to 1, from 0 to 1 itself."""
        series = np.concatenate([[0.0, 1.0], self.ratios])
        dark, bright = chebyshev.chebval([-1.0, 1.0], series)
        return (chebyshev.chebval(2 * np.asarray(grey) - 1, series) - dark) / (bright - dark)


def power_harmonics(gamma: float, count: int) -> np.ndarray:
    """h_1 to h_count of ((1 + cos ψ) / 2)^gamma."""
    factors = [(gamma - j) / (gamma + 1 + j) for j in range(1, count)]
    return np.cumprod([1.0, *factors])


def _gamma(second: float) -> float:
    return (1 + 2 * second) / (1 - second)


def _seen_second(h_2: float, h_3: float, steps: int) -> float:
    """What so many steps show for a second harmonic.

    Four take the third for a part of the fundamental, by which the second is divided and its phase is turned back:
    h_2 (1 - 3/2 h_3), to first order in h_3. Three show it as an error of the phase, over the phase that has it.
    """
    if steps == 4:
        return h_2 * (1 - 1.5 * h_3)
    if steps > 4:
        return h_2
    phase = np.linspace(0, 2 * np.pi, 120, endpoint=False)
    error = np.angle(1 + h_2 * np.exp(-3j * phase))
    seen = np.sin(3 * (phase + error))
    return float(-(seen @ error) / (seen @ seen))


@on_one_thread
def measure_harmonics(fit: FringeFit, grey_variance: np.ndarray, period_px: float) -> Harmonics:
    """By least squares over all pixels, beside what gains and shifts of single frames would do.

    The residual's component at the k-th harmonic of the steps, turned back by k times the phase, is B_k in a response's
    case. In four frames the second harmonic is its own mirror image, and only cos 2φ of it is seen.
    """
    n = len(fit.shifts)
    highest = n // 2 if n % 2 == 0 and n <= 4 else (n - 1) // 2
    ratios, sigmas = [], []
    for k in range(2, highest + 1):
        alone = 2 * k == n
        component = (1 if alone else 2) / n * np.exp(-1j * k * fit.shifts) @ fit.residual
        turned = np.exp(1j * k * fit.phase)
        if alone:
            basis = [np.cos(k * fit.phase), np.sin(k * fit.phase), np.cos(fit.phase), np.sin(fit.phase)]
            design = np.stack([*(fit.modulation * each for each in basis), fit.background])
            measured, variance = component.real, grey_variance / n
        else:
            design, measured, variance = fit.modulation[None], (component / turned).real, 2 * grey_variance / n
        weight = 1 / np.sqrt(variance)
        inverse = np.linalg.inv((design * weight**2) @ design.T)
        solved = inverse @ (design * weight**2 @ measured)
        excess = np.mean(((measured - solved @ design) * weight) ** 2)
        ratios.append(solved[0])
        sigmas.append(np.sqrt(inverse[0, 0] * max(excess, 1.0)))
    return Harmonics(period_px, n, np.array(ratios), np.array(sigmas))


def harmonics_of_three(sequence: Sequence) -> list[Harmonics]:
    """Second harmonics of sets of three steps, from how their phases disagree; none where orders are not a chain's.

    Three steps take the second harmonic for a part of the fundamental: the phase is off by -h_2 sin 3φ. Two sets are
    off at different places, so that the fringe-order residual K Φ_c - φ_f of eq. 5 holds both errors, told apart by
    least squares. What gains of single frames do goes with φ and 2φ and is estimated beside. Below, each set's phase
    carries the error that is looked for, which costs a share h_2 of it.
    """
    fringes, fits = sequence.fringes, sequence.fits
    if not fringes.spans_field or set(fringes.steps) != {3}:
        return []
    absolute = fits[0].phase - fringes.start
    absolute %= 2 * np.pi
    found = []
    for k, ratio in enumerate(fringes.ratios[1:], start=1):
        coarse, fine = fits[k - 1].phase, fits[k].phase
        own = fine - fringes.start
        turns = (ratio * absolute - own) / (2 * np.pi)
        residual = 2 * np.pi * (turns - np.rint(turns))
        columns = [wave(j * phase) for j in (3, 2, 1) for wave in (np.sin, np.cos) for phase in (fine, coarse)]
        design = np.column_stack([*columns, np.ones(len(residual))])
        weight = 1 / np.sqrt(
            2 / 3 * sequence.grey_variance * (fits[k].modulation ** -2.0 + ratio**2 * fits[k - 1].modulation ** -2.0)
        )
        weighted = design * weight[:, None]
        inverse = np.linalg.pinv(weighted.T @ weighted)
        solved = inverse @ weighted.T @ (residual * weight)
        excess = max(float(np.mean((weight * (residual - design @ solved)) ** 2)), 1.0)
        for column, scale, period in ((0, 1.0, fringes.periods[k]), (1, -ratio, fringes.periods[k - 1])):
            sigma = np.sqrt(inverse[column, column] * excess) / abs(scale)
            found.append(Harmonics(period, 3, np.array([solved[column] / scale]), np.array([sigma])))
        absolute = own + 2 * np.pi * np.rint(turns)
    return sorted(found, key=lambda each: -each.period_px)


def error_of_steps(ratios: np.ndarray, steps: int) -> float:
    """Root mean square of the phase error that harmonics h_1, h_2, ... make with so many steps, rad."""
    phase = np.linspace(0, 2 * np.pi, 360, endpoint=False)
    seen = np.zeros(len(phase), dtype=complex)
    for k, ratio in enumerate(ratios, start=1):
        for order in (k, -k):
            if (order - 1) % steps == 0:
                seen += ratio * np.exp(1j * (order - 1) * phase)
    return float(np.std(np.angle(seen)))


def check_response(sequence: Sequence, yardstick: Yardstick) -> list[Finding]:
    """A response that three steps, the fewest there are, would feel.

    What it does to the phase as taken may be nothing, which many steps are for.
    """
    steps, periods = sequence.fringes.steps, sequence.fringes.periods
    if len(sequence.pixels) == 0:
        return []
    modulation = [float(np.median(fit.modulation)) for fit in sequence.fits]
    able = [k for k, n in enumerate(steps) if n >= MIN_FRAMES and modulation[k] > _LEAST_SHARE * max(modulation)]
    of_sets = [measure_harmonics(sequence.fits[k], sequence.grey_variance, periods[k]) for k in able]
    if not of_sets:
        of_sets = harmonics_of_three(sequence)
    if not of_sets:
        return []
    second, sigma = _second_harmonic(of_sets)
    widest = of_sets[0]
    power = power_harmonics(widest.gamma, 2 * max(steps) + 2)
    three = error_of_steps(power_harmonics(_gamma(second), 4), 3)
    if three < yardstick.least_rad or abs(second) < norm.isf(FALSE_ALARM / 2) * sigma:
        return []
    quantised = sequence.frames.stack.dtype.kind == "u"
    if quantised and abs(second) * max(modulation) < np.sqrt(QUANTISATION_VARIANCE):
        return []  # rounding of faint fringes makes harmonics, too
    three, as_taken, gamma = error_of_steps(power, 3), error_of_steps(power, steps[-1]), widest.gamma
    gain = correction_gain(sequence)
    evidence: dict[str, float | str] = {
        "gamma": gamma,
        "second_harmonic": float(widest.ratios[0]),
        "second_harmonic_sd": sigma,
        "of_period_px": widest.period_px,
        "three_steps_rad": three,
    }
    in_um = yardstick.um(three)
    if in_um is not None:
        evidence["three_steps_um"] = in_um
    if gain is not None:
        evidence["three_of_these_steps_rad"], evidence["three_of_these_steps_corrected_rad"] = gain
    return [
        Finding(
            name="response",
            where=sequence.where,
            effect_rad=as_taken,
            effect_um=yardstick.um(as_taken),
            cause=f"the projector's light is not proportional to the patterns' grey: gamma {gamma:.3g}",
            remedy=f"send 255 (grey / 255)^{1 / gamma:.3g} in place of every grey value (--lut-out writes the table), "
            f"or switch the projector's gamma off; {steps[-1]} steps of the finest period leave {as_taken:.2g} rad "
            f"of it, three would leave {three:.2g} rad",
            evidence=evidence,
        )
    ]


def correction_table(gamma: float) -> np.ndarray:
    """(256,) uint8: what to send for each grey value so that the light is proportional to it."""
    return np.rint(255 * (np.arange(256) / 255) ** (1 / gamma)).astype(np.uint8)


def correction_gain(sequence: Sequence) -> tuple[float, float] | None:
    """What three of the frames' own steps err by against all of them, rad: as they are, and without their harmonics.

    The second is what patterns that are corrected leave, for light that is linear passes blur as it is; noise is in
    both. None unless some set has a multiple of three frames, six or more.
    """
    able = [k for k, n in enumerate(sequence.fringes.steps) if n >= 6 and n % 3 == 0]
    if not able:
        return None
    k = able[-1]
    part, fit = sequence.fringes.slices[k], sequence.fits[k]
    grey, shifts = sequence.grey[part], sequence.shifts[part]
    harmonics = measure_harmonics(fit, sequence.grey_variance, sequence.fringes.periods[k])
    linear = grey - harmonics.light(fit)
    return _three_step_error(grey, shifts, fit.phase), _three_step_error(linear, shifts, fit.phase)


def _second_harmonic(of_sets: Many[Harmonics]) -> tuple[float, float]:
    """Median over the sets, and its standard deviation: by noise, or by how the sets differ where that is more."""
    second = np.array([each.ratios[0] for each in of_sets])
    own = np.sqrt(np.mean([each.sigma[0] ** 2 for each in of_sets]))
    between = np.std(second, ddof=1) if len(second) > 1 else 0.0
    return float(np.median(second)), float(max(own, between) / np.sqrt(len(second)))


def _three_step_error(grey: np.ndarray, shifts: np.ndarray, phase: np.ndarray) -> float:
    third = len(shifts) // 3
    squares = []
    for first in range(third):
        chosen = slice(first, None, third)
        apart = fit_fringes(grey[chosen], shifts[chosen]).phase - phase
        squares.append(np.angle(np.exp(1j * apart)) ** 2)
    return float(np.sqrt(np.mean(squares)))
