"""Fringes of a level face under a projector and a camera in one dimension, with one fault at a time."""

from collections.abc import Callable

import numpy as np
import pytest

from greenough.instrument.contract import CameraNoise
from greenough.pipeline.diagnosis.sequence import Sequence, sequence_of
from greenough.pipeline.fringes import FringeSet

NOISE = CameraNoise(6500.0, 10.0, 25.9)
FRINGES = FringeSet((608, 152, 40, 12), (4, 4, 4, 12))
SHAPE = (60, 160)


def painted(
    fringes: FringeSet = FRINGES,
    *,
    seed: int = 1,
    gamma: float = 1.0,
    gains: np.ndarray | float = 1.0,
    shifts_px: np.ndarray | float = 0.0,
    full_dn: float = 180.0,
    ambient_dn: float = 0.0,
    noise: CameraNoise | None = NOISE,
    light: np.ndarray | float = 1.0,
) -> np.ndarray:
    """Frames (frames, rows, cols) uint8: columns 3.5 projector columns apart, brightness that falls off by a third.

    ``gains`` and ``shifts_px`` (projector columns) are those of each frame.
    """
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]]
    column = 20.0 + 3.5 * u + 0.3 * v
    shade = 1 - 0.3 * ((u - 80) / 80) ** 2
    frames = fringes.frame_count
    gain, shift = (np.broadcast_to(each, frames) for each in (gains, shifts_px))
    rng = np.random.default_rng(seed)
    stack = np.empty((frames, *SHAPE), dtype=np.uint8)
    n = 0
    for period, steps in zip(fringes.periods, fringes.steps, strict=True):
        for step in range(steps):
            angle = 2 * np.pi * ((column + shift[n]) / period + fringes.sign * step / steps) + fringes.start
            dn = gain[n] * (full_dn * ((1 + np.cos(angle)) / 2) ** gamma + ambient_dn) * shade * light
            if noise is not None:
                electrons = noise.electrons_per_dn * dn
                dn = (electrons + np.sqrt(electrons + noise.read_noise_e**2) * rng.standard_normal(SHAPE)) / (
                    noise.electrons_per_dn
                )
            stack[n] = np.clip(np.rint(dn), 0, 255)
            n += 1
    return stack


@pytest.fixture(scope="session")
def paint() -> Callable[..., np.ndarray]:
    return painted


@pytest.fixture(scope="session")
def taken() -> Callable[..., Sequence]:
    """A sequence of painted frames, or of given ones."""

    def made(stack: np.ndarray | None = None, fringes: FringeSet = FRINGES, **changes) -> Sequence:
        return sequence_of("test", painted(fringes, **changes) if stack is None else stack, fringes, NOISE, quiet=True)

    return made
