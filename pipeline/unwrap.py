"""Multi-frequency unwrapping: the paper's eq. 5, with the wrap of the unit-frequency set guarded.

The functions take and return Dr.Jit arrays, one entry per pixel, so that they become part of the decoder's kernel.

The chain of eq. 5 starts from the coarsest set, whose phase is taken to be absolute. Next to the first and the last
column noise carries that phase across 0 or 2π, and the pixel starts at the wrong end of the field. So two chains are
followed, from the phase as measured and from its neighbour one turn away, and compared:

- A chain is possible only if it ends inside the field, that is on one of the columns that the coarsest period spans.
- Each chain predicts the phases of the coarser sets from that of the densest one. For Gaussian noise, half the
  difference of their weighted squared misfits is the logarithm of the odds between the two chains.

In the paper's set a wrong start ends 600 columns away (50 periods of the densest set), which lies inside the field
only for the outermost 8 or 9 columns on either side. The odds decide there, and where they do not suffice the pixel
stays unresolved. So does a pixel whose only possible chain is excluded by the odds.

The coarser sets only count fringes and are not averaged into the phase. With N_i steps of the period p_i they would
take the share N_i p² / (N p_i²) of its variance, a few per cent, but interreflection and blur draw wide fringes
otherwise than narrow ones, and on solder their weighted difference is more than the noise gained
(``tests/full/test_coarse_sets.py`` measures both).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import log, pi
from statistics import NormalDist

from .fringes import FringeSet
from .jit import Bool, Float, dr

ERROR_PROBABILITY = 1e-6
"""Accepted probability, per pixel, of a wrong fringe order."""

RESIDUAL_LIMIT = pi / 2
"""Largest fringe-order residual of a valid pixel: half of the π at which rounding goes to the next order."""

# Column 0 is a mirror from -1/2 to 1/2; half a column more at either end admits counts that begin at a mirror's edge.
_EDGE_COLUMNS = 1.0
_EDGE_SIGMAS = 6.0  # by which noise may carry a phase beyond


@dataclass(frozen=True)
class Unwrapped:
    """Absolute phase of the densest set.

    Parameters
    ----------
    absolute : Float
        Absolute phase, rad.
    residual : Float
        Fringe-order residual K_i Φ_(i-1) - Φ_i of the step where it is largest in magnitude, rad, within ±π.
    resolved : Bool
        Whether the phase lies inside the field and the other chain is excluded.
    """

    absolute: Float
    residual: Float
    resolved: Bool


def unwrap(wrapped: Sequence[Float], variance: Sequence[Float], fringes: FringeSet) -> Unwrapped:
    """Absolute phase from the wrapped phases of all sets.

    Parameters
    ----------
    wrapped : one Float per set
        Wrapped phase φ_i, rad, on any branch.
    variance : one Float per set
        Variance of φ_i, rad².
    fringes : FringeSet
        What was projected.
    """
    start = wrapped[0] - 2 * pi * dr.floor(wrapped[0] / (2 * pi))  # [0, 2π)
    neighbour = start + dr.select(start < pi, 2 * pi, -2 * pi)
    here, there = (_follow(first, wrapped, variance, fringes) for first in (start, neighbour))

    use_there = there.inside & (~here.inside | (there.misfit < here.misfit))
    chosen_fits_worse = dr.select(use_there, there.misfit > here.misfit, here.misfit > there.misfit)
    odds_decide = dr.abs(here.misfit - there.misfit) > 2 * log(1 / ERROR_PROBABILITY)
    return Unwrapped(
        absolute=dr.select(use_there, there.absolute, here.absolute),
        residual=dr.select(use_there, there.residual, here.residual),
        resolved=dr.select(
            here.inside & there.inside,
            odds_decide,
            (here.inside | there.inside) & ~(odds_decide & chosen_fits_worse),
        ),
    )


def order_is_safe(variance: Sequence[Float], fringes: FringeSet) -> Bool:
    """Whether noise leaves the fringe order wrong with a probability below ``ERROR_PROBABILITY``.

    The quantity that eq. 5 rounds has the variance s² = σ_i² + K_i² σ_(i-1)², so that the order is wrong with the
    probability 2 Q(π / s), where Q is the upper tail of the normal distribution. The accepted probability is shared
    evenly by the steps of the chain. Of a set without modulation, noise makes an apparent modulation b with the
    density of Rayleigh; each set's own modulation must exceed what noise reaches with the accepted probability, which
    is σ_i² < 1 / (2 ln(1 / probability)).
    """
    safe = Bool(True)
    for own in variance:
        safe &= own < 1 / (2 * log(1 / ERROR_PROBABILITY))
    steps = len(variance) - 1
    if steps:
        sigmas = NormalDist().inv_cdf(1 - ERROR_PROBABILITY / (2 * steps))
        for i in range(1, len(variance)):
            safe &= variance[i] + fringes.ratios[i] ** 2 * variance[i - 1] < (pi / sigmas) ** 2
    return safe


@dataclass(frozen=True)
class _Chain:
    absolute: Float
    residual: Float
    misfit: Float  # Σ (Φ_i - Φ_M p_M / p_i)² / variance over the coarser sets
    inside: Bool  # ends inside the field


def _follow(start: Float, wrapped: Sequence[Float], variance: Sequence[Float], fringes: FringeSet) -> _Chain:
    """Eq. 5 from the coarsest to the densest set."""
    phases = [start]
    worst = Float(0)
    for ratio, phi in zip(fringes.ratios[1:], wrapped[1:], strict=True):
        expected = ratio * phases[-1]
        phase = phi + 2 * pi * dr.round((expected - phi) / (2 * pi))
        residual = expected - phase
        worst = dr.select(dr.abs(residual) > dr.abs(worst), residual, worst)
        phases.append(phase)

    densest = phases[-1]
    misfit = Float(0)
    for phase, own, period in zip(phases[:-1], variance[:-1], fringes.periods[:-1], strict=True):
        scale = fringes.periods[-1] / period
        misfit += dr.square(phase - scale * densest) / (own + scale**2 * variance[-1])

    per_column = 2 * pi / fringes.periods[-1]
    edge = _EDGE_COLUMNS * per_column + _EDGE_SIGMAS * dr.sqrt(variance[-1])
    last = (fringes.periods[0] - 1) * per_column
    inside = (densest > -edge) & (densest < last + edge)
    return _Chain(densest, worst, misfit, inside)
