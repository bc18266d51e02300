"""Fringe orders where no period spans the field: the one at which the phases of all sets fit together.

Periods of 70, 64 and 59 columns, say, repeat together only after many thousand columns. Every order k of the densest
set that lies inside the field puts the pixel on the column (k + φ_M / 2π) p_M, and so predicts the phases of the other
sets; the order with the least misfit, weighted by the phases' variances, is taken. A Gray code, or whatever else knows
roughly where on the projector a pixel is, narrows the search.

An order is resolved only if the next best one is behind by the logarithm of the odds that `unwrap` asks for, and
misfits by twice as much, for harmonics in the phases, of which no variance knows. That is a margin and no proof: phases
that are bent by more than half of what tells two orders apart may fit a wrong one best. More steps bend less.

The functions take and return Dr.Jit arrays, one entry per pixel, so that they become part of the decoder's kernel.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil, log, pi
from typing import Any

import numpy as np

from greenough.instrument.errors import InputError

from .fringes import FringeSet
from .jit import Bool, Float, dr
from .unwrap import EDGE_SIGMAS, ERROR_PROBABILITY, Unwrapped, weights_and_edge

_FARTHER = 2.0  # by how much the next best order must misfit more, in rad
_SAME = 0.05  # rad: columns whose phases are nearer than this are taken for alike


@dataclass(frozen=True, eq=False)
class ColumnWindow:
    """Where on the projector each pixel is, roughly.

    Parameters
    ----------
    centre : (rows, cols)
        Columns; NaN where nothing is known, and the pixel is not decoded.
    half_width : (rows, cols)
        How far from the centre it may be, columns.
    """

    centre: np.ndarray
    half_width: np.ndarray


def search_order(
    wrapped: Sequence[Float],
    variance: Sequence[Float],
    fringes: FringeSet,
    window: tuple[Float, Float] | None = None,
) -> Unwrapped:
    """Absolute phase from the wrapped phases of all sets.

    Parameters
    ----------
    wrapped : one Float per set
        Wrapped phase φ_i, rad, on any branch.
    variance : one Float per set
        Variance of φ_i, rad².
    fringes : FringeSet
        With a field.
    window : centre and half width, optional
        Columns, as in ``ColumnWindow``. Of a single set the order nearest to the centre is taken.
    """
    densest, coarser = fringes.periods[-1], fringes.periods[:-1]
    turns = [phase / (2 * pi) for phase in wrapped]
    own = turns[-1] - dr.floor(turns[-1])
    scales = [densest / period for period in coarser]
    weights, edge = weights_and_edge(variance, fringes)
    field = fringes.field if fringes.field is not None else fringes.periods[0]
    last = (field - 1) / densest
    centre, half = (window[0] / densest, window[1] / densest) if window else (Float(0), Float(0))

    def misfits(at: Float) -> list[Float]:
        """Of the coarser sets, turns within ±1/2."""
        apart = [dr.fma(at, scale, -turn) for scale, turn in zip(scales, turns[:-1], strict=True)]
        return [value - dr.round(value) for value in apart]

    def step(order: Float, best: Float, second: Float, chosen: Float) -> tuple[Float, Float, Float, Float]:
        at = own + order
        inside = (at > -edge) & (at < last + edge)
        if window:
            inside &= dr.abs(at - centre) <= half
        misfit = Float(0)
        for weight, value in zip(weights, misfits(at), strict=True):
            misfit = dr.fma(weight, dr.square(value), misfit)
        if window and not coarser:
            misfit = dr.square(at - centre)
        misfit = dr.select(inside, misfit, dr.inf)
        better = misfit < best
        second = dr.select(better, best, dr.minimum(second, misfit))
        return order + 1, dr.select(better, misfit, best), second, dr.select(better, order, chosen)

    count = dr.width(own)
    start = (dr.full(Float, -1, count), *(dr.full(Float, dr.inf, count) for _ in range(2)), dr.zeros(Float, count))
    end = ceil(last) + 1
    loop: Any = dr.while_loop  # whose stub wants one type for all that goes through it
    _, best, second, chosen = loop(start, lambda order, *_: order < end, step)
    absolute = own + chosen
    residual = dr.zeros(Float, count)
    for value in misfits(absolute):
        residual = dr.select(dr.abs(value) > dr.abs(residual), value, residual)
    resolved: Bool = dr.isfinite(best)
    if not coarser:  # two orders at whose middle the centre lies are told apart by noise
        resolved &= dr.sqrt(second) - dr.sqrt(best) > EDGE_SIGMAS / pi * dr.sqrt(variance[-1])
    else:
        resolved &= (second - best > 2 * log(1 / ERROR_PROBABILITY)) & (second > _FARTHER**2 * best)
    return Unwrapped(absolute=2 * pi * absolute, residual=2 * pi * residual, resolved=resolved)


def check_orders(fringes: FringeSet, window: ColumnWindow | None) -> None:
    """InputError where no noise is low enough to tell the orders of this set from each other."""
    densest, coarser = fringes.periods[-1], fringes.periods[:-1]
    field = fringes.field if fringes.field is not None else fringes.periods[0]
    reach = field if window is None else min(field, 2 * float(np.nanmax(window.half_width, initial=0.0)))
    apart = densest * np.arange(1, int((reach - 1) // densest) + 1)  # columns between orders
    if not coarser:
        if window is None and len(apart):
            raise InputError(
                f"fringe set: one period of {densest:g} columns does not span the field of {field:g}; give another "
                "period or a Gray code beside it"
            )
        if window is not None and reach > 2 * densest:
            raise InputError(
                f"Gray code: its stripes leave {reach:g} columns open, too many for one period of {densest:g}; give "
                "finer stripes or another period"
            )
        return
    turns = apart[:, None] / np.array(coarser)  # (orders, sets)
    distance = 2 * pi * np.linalg.norm(turns - np.rint(turns), axis=1)
    if (distance < _SAME).any():
        repeats = apart[np.argmax(distance < _SAME)]
        raise InputError(
            f"fringe set: periods {fringes.periods} repeat together every {repeats:g} columns of a field of {field:g}; "
            "give other periods, a smaller field or a Gray code beside them"
        )
