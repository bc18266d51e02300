"""Smooth residual fields: what a path does beyond its simple model, as polynomials over its picture and in depth."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

_ROOM = 1.05


@dataclass(frozen=True, eq=False)
class DepthField:
    """Terms of a smooth field over a picture that changes linearly with height: B(s, t) and z / depth C(s, t).

    B and C are products P_i(s) P_j(t) of Legendre polynomials, s, t = (p - centre) / half_range for a point p of the
    picture. Beyond the rectangle -1 <= s, t <= 1 they stay what they are at its rim: nothing is known there, and
    polynomials would run away.

    Parameters
    ----------
    centre, half_range : tuple of 2 floats
        Of the rectangle.
    fixed_degrees, depth_degrees : tuple of 2 ints
        Lowest and highest total degree i + j of B and of C; none if the highest is below the lowest.
    depth_mm : float
        Height at which the terms of C have grown to their full size.
    """

    centre: tuple[float, float]
    half_range: tuple[float, float]
    fixed_degrees: tuple[int, int]
    depth_degrees: tuple[int, int]
    depth_mm: float

    @classmethod
    def around(
        cls, points: np.ndarray, fixed_degrees: tuple[int, int], depth_degrees: tuple[int, int], depth_mm: float
    ) -> "DepthField":
        """A field whose rectangle holds these points (n, 2), and some room: blocks and spots are wider than points."""
        low, high = points.min(axis=0), points.max(axis=0)
        centre, half_range = (low + high) / 2, _ROOM * (high - low) / 2
        return cls((centre[0], centre[1]), (half_range[0], half_range[1]), fixed_degrees, depth_degrees, depth_mm)

    @cached_property
    def orders(self) -> np.ndarray:
        """(terms, 2): i and j of each term, those of B first, by rising total degree."""
        ranges = (range(low, high + 1) for low, high in (self.fixed_degrees, self.depth_degrees))
        return np.array([(n - j, j) for degrees in ranges for n in degrees for j in range(n + 1)])

    @cached_property
    def with_depth(self) -> np.ndarray:
        """(terms,) bool: which terms belong to C."""
        low, high = self.fixed_degrees
        fixed = sum(n + 1 for n in range(low, high + 1))
        return np.arange(len(self.orders)) >= fixed

    def values(self, points: np.ndarray, z: np.ndarray) -> np.ndarray:
        """Every term at points (n, 2) and heights (n,): (n, terms)."""
        i, j = self.orders.T
        (s, _), (t, _) = self._along(points)
        terms = (s[i] * t[j]).T
        terms[:, self.with_depth] *= z[:, None] / self.depth_mm
        return terms

    def linearise(self, points: np.ndarray, z: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Terms (n, terms) and their derivatives by the point (n, terms, 2) and by z (n, terms)."""
        i, j = self.orders.T
        (s, ds), (t, dt) = self._along(points)
        terms = (s[i] * t[j]).T
        slopes = np.stack([(ds[i] * t[j]).T, (s[i] * dt[j]).T], axis=-1) / self.half_range
        by_z = np.where(self.with_depth, terms / self.depth_mm, 0.0)
        depth = z[:, None] / self.depth_mm
        terms[:, self.with_depth] *= depth
        slopes[:, self.with_depth] *= depth[..., None]
        return terms, slopes, by_z

    def _along(self, points: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
        highest = max(self.fixed_degrees[1], self.depth_degrees[1])
        scaled = (points - np.array(self.centre)) / self.half_range
        return [_legendre(column, highest) for column in scaled.T]


def _legendre(x: np.ndarray, highest: int) -> tuple[np.ndarray, np.ndarray]:
    """P_0 to P_highest at x (n,) kept within -1 to 1, and their derivatives, (highest + 1, n) each, by recursion."""
    inside = np.clip(x, -1.0, 1.0)
    values, slopes = np.ones((highest + 1, len(x))), np.zeros((highest + 1, len(x)))
    for n in range(1, highest + 1):
        before = (values[n - 2], slopes[n - 2]) if n > 1 else (0.0, 0.0)
        values[n] = ((2 * n - 1) * inside * values[n - 1] - (n - 1) * before[0]) / n
        slopes[n] = (2 * n - 1) * values[n - 1] + before[1]
    return values, np.where(inside == x, slopes, 0.0)
