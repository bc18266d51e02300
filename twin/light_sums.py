"""Pictures of patterns that have moved a little, as sums of pictures of the same patterns before they moved.

Light adds up: what is a sum of patterns on the mirrors is the same sum of pictures, however the light gets there. A
fringe that moves is a sum of itself, of another one of its set and of white, but for the rounding of its grey values
and for its ends. What a sum leaves of a pattern is known before anything is rendered, and no pixel errs by a larger
share of its light under white.
"""

from dataclasses import dataclass

import numpy as np

LARGEST_REST = 2.5e-4
"""Of white: what a sum may leave of a pattern, about a sixteenth of a grey value of 8 bits."""

RIM = 8
"""Columns at either end of the array that do not count: the rim of the light stays where it was."""


@dataclass(frozen=True, eq=False)
class Sums:
    """N patterns as sums of three others each.

    Parameters
    ----------
    terms : (N, 3) int
        Indices of the others.
    weights : (N, 3) float64
    rest : float
        Largest light that is left of any pattern, relative to white.
    """

    terms: np.ndarray
    weights: np.ndarray
    rest: float


def as_sums(moved: np.ndarray, own: np.ndarray, patterns: np.ndarray) -> Sums:
    """The sums that come nearest, by least squares.

    Parameters
    ----------
    moved : (N, cells)
        Patterns' light along the columns of the array, after diffraction, relative to white.
    own : (N,) int
        Which of ``patterns`` has moved.
    patterns : (M, cells)
        The same before they moved; the first is white.

    Returns
    -------
    Sums
        Each of the pattern itself, of white, and of one of all patterns: of that with which the least is left.
    """
    terms, weights = np.empty((len(moved), 3), int), np.empty((len(moved), 3))
    rest = 0.0
    for n, (light, k) in enumerate(zip(moved, own, strict=True)):
        terms[n], weights[n] = (k, 0, k), (1, 0, 0)
        if np.array_equal(light, patterns[k]):
            continue
        basis = np.linalg.qr(patterns[[k, 0]].T)[0]
        change, others = light - patterns[k], patterns - (patterns @ basis) @ basis.T
        lengths = np.linalg.norm(others, axis=1)
        usable = lengths > 1e-3 * lengths.max()  # of the others nothing but rounding is left
        along = np.abs(others @ change) / np.where(usable, lengths, np.inf)
        terms[n, 2] = np.argmax(along)
        chosen = patterns[terms[n]].T
        weights[n] += np.linalg.lstsq(chosen, change)[0]
        rest = max(rest, float(np.abs(light - chosen @ weights[n]).max()))
    return Sums(terms, weights, rest)
