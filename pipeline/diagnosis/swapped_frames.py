"""Frames that stand in another order than the patterns: which, found by trying all others of a kind."""

from collections.abc import Iterator
from collections.abc import Sequence as Many
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from scipy.stats import chi2

from ..decode import decode
from ..fringes import FringeSet
from .finding import FALSE_ALARM, Finding, Yardstick
from .sequence import Sequence, fit_fringes

_EXPLAINS = 0.5  # of what the order as given leaves over must be gone
_NOTHING_LEFT = 1.5  # times noise: half of it would be less than noise
_LOST = -1  # pattern that no frame shows


@dataclass(frozen=True)
class Order:
    """Which pattern each frame shows.

    Parameters
    ----------
    text : str
        In words.
    shown : tuple of int
        Number of the pattern that each frame shows, from 0; -1 where it shows none of the set.
    """

    text: str
    shown: tuple[int, ...]

    def rearranged(self, stack: np.ndarray) -> np.ndarray | None:
        """The frames in the order of the patterns; None where a pattern is missing."""
        if set(self.shown) != set(range(len(self.shown))):
            return None
        return stack[np.argsort(self.shown)]


def candidate_orders(count: int) -> Iterator[Order]:
    """Two frames exchanged, one repeated with all behind it late, one dropped with all behind it early."""
    for first, second in combinations(range(count), 2):
        shown = list(range(count))
        shown[first], shown[second] = second, first
        yield Order(f"frames {first} and {second} are exchanged", tuple(shown))
    for k in range(count - 1):
        late = (*range(k + 1), *range(k, count - 1))
        yield Order(f"frame {k + 1} repeats frame {k}, and those behind it come one late", late)
    for k in range(count - 1):
        early = (*range(k), *range(k + 1, count), _LOST)
        yield Order(f"frame {k} was dropped, and those behind it come one early", early)


def find_order(sequence: Sequence) -> Order | None:
    """An order that explains the frames where the given one does not, or None.

    Each order is judged by what fringes leave over in all sets and by how the phases of neighbouring sets fit
    together, both over noise: the second tells what the first cannot, two of four frames exchanged that are opposite.
    The best must leave less than half of what the given order leaves, and the drop must exceed what chi-square allows
    by chance with ``FALSE_ALARM`` over all orders, counted in what the best one leaves over.
    """
    if len(sequence.pixels) == 0:
        return None
    judge = _Judge(sequence)
    given = judge.misfit(tuple(range(sequence.fringes.frame_count)))
    if given < _NOTHING_LEFT or given == np.inf:
        return None
    orders = list(candidate_orders(sequence.fringes.frame_count))
    misfits = np.array([judge.misfit(order.shown) for order in orders])
    best = int(np.argmin(misfits))
    drop = (given - misfits[best]) * len(sequence.pixels) / max(misfits[best], 1e-12)
    chance = chi2.isf(FALSE_ALARM / len(orders), len(sequence.pixels))
    return orders[best] if misfits[best] < _EXPLAINS * given and drop > chance else None


def rearranged(sequence: Sequence, order: Order | None) -> Sequence | None:
    """The sequence with its frames in the order of the patterns; None where one is missing."""
    if order is None:
        return sequence
    stack = order.rearranged(sequence.frames.stack)
    return None if stack is None else replace(sequence, frames=replace(sequence.frames, stack=stack))


def order_finding(sequence: Sequence, order: Order, yardstick: Yardstick) -> Finding:
    """What an order that `find_order` found means."""
    repaired = rearranged(sequence, order)
    if repaired is None:
        effect, lost = 2 * np.pi, 1.0
        remedy = "capture again: a pattern is missing, so that no order of these frames is right"
    else:
        effect, lost = _difference(sequence, repaired)
        remedy = "put them in order, or capture again; check how the projector's sequence and the camera are triggered"
    return Finding(
        name="frame order",
        where=f"{sequence.where}: {order.text}",
        effect_rad=effect,
        effect_um=yardstick.um(effect),
        cause="frames do not stand in the order of the patterns",
        remedy=remedy,
        evidence={"lost_share": lost},
    )


def _difference(sequence: Sequence, repaired: Sequence) -> tuple[float, float]:
    """Root mean square change of the phase, rad, where a lost pixel counts as a fringe, and the lost share."""
    if not sequence.tells_orders:
        turned = np.exp(1j * (sequence.fits[-1].phase - repaired.fits[-1].phase))
        return float(np.sqrt(np.mean(np.angle(turned) ** 2))), 0.0
    as_given, right = (decode(each.frames, each.fringes, each.variance) for each in (sequence, repaired))
    if not right.valid.any():
        return 2 * np.pi, 1.0
    apart = np.where(as_given.valid, np.abs(as_given.absolute - right.absolute), 2 * np.pi)[right.valid]
    effect = float(np.sqrt(np.mean(np.minimum(apart, 2 * np.pi) ** 2)))
    return effect, float(1 - as_given.valid[right.valid].mean())


class _Judge:
    """Misfit of orders, with what they have in common computed once."""

    def __init__(self, sequence: Sequence):
        self._sequence = sequence
        self._fitted: dict[tuple, tuple[float, np.ndarray, np.ndarray]] = {}

    def misfit(self, shown: tuple[int, ...]) -> float:
        """Mean square, in standard deviations of noise, per degree of freedom; infinite where none is left."""
        fringes = self._sequence.fringes
        members = [[n for n, k in enumerate(shown) if part.start <= k < part.stop] for part in fringes.slices]
        sets = [self._fit(tuple(frames), tuple(shown[n] for n in frames)) for frames in members]
        squares = [(square, len(fitted) - 3) for (square, _, _), fitted in zip(sets, members, strict=True)]
        if fringes.spans_field:
            squares += [(square, 1) for square in _disagreements(sets, fringes)]
        freedom = sum(max(each, 0) for _, each in squares)
        return sum(square for square, _ in squares) / freedom if freedom else np.inf

    def _fit(self, frames: tuple[int, ...], shown: tuple[int, ...]) -> tuple[float, np.ndarray, np.ndarray]:
        """Mean square left over by one set, and its phases and their variances."""
        key = (frames, shown)
        if key not in self._fitted:
            s = self._sequence
            if len(frames) < 3:
                return 0.0, np.full(len(s.pixels), np.nan), np.full(len(s.pixels), np.nan)
            fit = fit_fringes(s.grey[list(frames)], s.shifts[list(shown)])
            square = float(np.mean(np.sum(fit.residual**2, axis=0) / s.grey_variance))
            variance = 2 / len(frames) * s.grey_variance / np.maximum(fit.modulation, 1e-9) ** 2
            self._fitted[key] = square, fit.phase - s.fringes.start, variance
        return self._fitted[key]


def _disagreements(sets: Many[tuple[float, np.ndarray, np.ndarray]], fringes: FringeSet) -> list[float]:
    """Of each step of eq. 5, the mean square of the fringe-order residual over its variance; none of lost sets.

    The coarsest phase is taken as it is: the few pixels beyond its wrap change no mean.
    """
    (_, phase, variance), *finer = sets
    absolute, squares = phase % (2 * np.pi), []
    for ratio, (_, own, own_variance) in zip(fringes.ratios[1:], finer, strict=True):
        turns = (ratio * absolute - own) / (2 * np.pi)
        apart = 2 * np.pi * (turns - np.rint(turns))
        if not (np.isfinite(phase).all() and np.isfinite(own).all()):
            break
        squares.append(float(np.mean(apart**2 / (own_variance + ratio**2 * variance))))
        absolute, variance = own + 2 * np.pi * np.rint(turns), own_variance
    return squares
