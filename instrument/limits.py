"""Refusals that every rig words alike, raised before anything is sent to a device."""

import numpy as np

from .errors import InputError


def check_within(value: float, limits: tuple[float, float], what: str, unit: str) -> None:
    """Raise InputError unless ``limits[0] <= value <= limits[1]``; not-a-number is outside."""
    low, high = limits
    if not low <= value <= high:
        raise InputError(f"{what} of {value:g} {unit} is outside its limits, {low:g} to {high:g} {unit}")


def check_patterns(patterns: np.ndarray, shape: tuple[int, int]) -> None:
    """Raise InputError unless ``patterns`` is (N, rows, cols) uint8 with N >= 1 for a projector of ``shape``."""
    patterns = np.asanyarray(patterns)
    if patterns.dtype != np.uint8 or patterns.ndim != 3 or patterns.shape[1:] != shape or len(patterns) == 0:
        raise InputError(
            f"patterns are {patterns.dtype} of shape {patterns.shape}; the projector takes uint8 of shape "
            f"(N, {shape[0]}, {shape[1]}) with at least one pattern"
        )
