"""The roots of chance: the instrument as it was built, the course of a run, and the noise of each exposure."""

import hashlib

import numpy as np


def _key(*parts: object) -> int:
    digest = hashlib.sha256("\x1f".join(map(str, parts)).encode()).digest()
    return int.from_bytes(digest[:8], "little")


def instrument_rng(seed: int, what: str) -> np.random.Generator:
    """Numbers for one part of the instrument: the same in every run, and of no other part."""
    return np.random.default_rng(_key("instrument", seed, what))


def exposure_key(seed: int, run: str, serial: int) -> int:
    """64 bits that belong to exposure ``serial`` of ``run`` alone."""
    return _key("exposure", seed, run, serial)


def exposure_rng(seed: int, run: str, serial: int, what: str) -> np.random.Generator:
    """Numbers for one thing that changes from exposure to exposure; independent of its camera noise."""
    return np.random.default_rng(_key("exposure", seed, run, serial, what))


def run_rng(seed: int, run: str, what: str) -> np.random.Generator:
    """Numbers for one thing that changes in the course of a run."""
    return np.random.default_rng(_key("run", seed, run, what))
