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
EDGE_SIGMAS = 6.0  # by which noise may carry a phase beyond


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
    turns = [phase / (2 * pi) for phase in wrapped]
    weights, edge = weights_and_edge(variance, fringes)
    start = turns[0] - dr.floor(turns[0])
    neighbour = start + dr.select(start < 0.5, 1, -1)
    here, there = (_follow(first, turns, weights, edge, fringes) for first in (start, neighbour))

    use_there = there.inside & (~here.inside | (there.misfit < here.misfit))
    chosen_fits_worse = dr.select(use_there, there.misfit > here.misfit, here.misfit > there.misfit)
    odds_decide = dr.abs(here.misfit - there.misfit) > 2 * log(1 / ERROR_PROBABILITY)
    residual = dr.zeros(Float, dr.width(start))  # of a single set, which has no step
    for own, other in zip(here.residuals, there.residuals, strict=True):
        of_step = dr.select(use_there, other, own)
        residual = dr.select(dr.abs(of_step) > dr.abs(residual), of_step, residual)
    return Unwrapped(
        absolute=2 * pi * dr.select(use_there, there.densest, here.densest),
        residual=2 * pi * residual,
        resolved=dr.select(
            here.inside & there.inside,
            odds_decide,
            (here.inside | there.inside) & ~(odds_decide & chosen_fits_worse),
        ),
    )


def weights_and_edge(variance: Sequence[Float], fringes: FringeSet) -> tuple[list[Float], Float]:
    """Inverse variances of the coarser sets' misfits, 1/turns², and by how much a phase may lie outside, turns.

    A misfit is that of a coarser set's phase to what the densest set's predicts.
    """
    scales = [fringes.periods[-1] / period for period in fringes.periods[:-1]]
    weights = [(2 * pi) ** 2 / (own + k**2 * variance[-1]) for own, k in zip(variance[:-1], scales, strict=True)]
    return weights, _EDGE_COLUMNS / fringes.periods[-1] + EDGE_SIGMAS / (2 * pi) * dr.sqrt(variance[-1])


def order_is_safe(variance: Sequence[Float], fringes: FringeSet) -> Bool:
    """Whether noise leaves the fringe order wrong with a probability below ``ERROR_PROBABILITY``.

    The quantity that eq. 5 rounds has the variance s² = σ_i² + K_i² σ_(i-1)², so that the order is wrong with the
    probability 2 Q(π / s), where Q is the upper tail of the normal distribution. The accepted probability is shared
    evenly by the steps of the chain. All sets must be modulated besides.
    """
    safe = is_modulated(variance)
    steps = len(variance) - 1
    if steps:
        sigmas = NormalDist().inv_cdf(1 - ERROR_PROBABILITY / (2 * steps))
        for i in range(1, len(variance)):
            safe &= variance[i] + fringes.ratios[i] ** 2 * variance[i - 1] < (pi / sigmas) ** 2
    return safe


def is_modulated(variance: Sequence[Float]) -> Bool:
    """Whether all sets show more than noise.

    Of a set without modulation, noise makes an apparent modulation b with the density of Rayleigh; each set's own
    modulation must exceed what noise reaches with the accepted probability, that is σ_i² < 1 / (2 ln(1 / probability)).
    """
    modulated = Bool(True)
    for own in variance:
        modulated &= own < 1 / (2 * log(1 / ERROR_PROBABILITY))
    return modulated


@dataclass(frozen=True)
class _Chain:
    """Phases in turns of 2π, so that fringe orders are whole numbers."""

    densest: Float  # Φ_M
    residuals: list[Float]  # of each step
    misfit: Float  # Σ (Φ_i - Φ_M p_M / p_i)² / variance over the coarser sets
    inside: Bool  # ends inside the field


def _follow(start: Float, turns: Sequence[Float], weights: Sequence[Float], edge: Float, fringes: FringeSet) -> _Chain:
    """Eq. 5 from the coarsest to the densest set.

    ``weights`` are the inverse variances of the coarser sets' misfits, and the chain may end outside the field by
    ``edge``; all is in turns.
    """
    phases, residuals = [start], []
    for ratio, own in zip(fringes.ratios[1:], turns[1:], strict=True):
        turns_apart = dr.fma(ratio, phases[-1], -own)
        order = dr.round(turns_apart)
        phases.append(own + order)
        residuals.append(turns_apart - order)

    densest = phases[-1]
    misfit = Float(0)
    for phase, weight, period in zip(phases[:-1], weights, fringes.periods[:-1], strict=True):
        misfit = dr.fma(dr.square(dr.fma(-fringes.periods[-1] / period, densest, phase)), weight, misfit)

    last = (fringes.periods[0] - 1) / fringes.periods[-1]
    return _Chain(densest, residuals, misfit, (densest > -edge) & (densest < last + edge))
