"""How long frames take to phase and to points, and how often orders go wrong, beside NumPy and the package `fringes`.

All decode the same frames of known phase, with the same noise. `fringes` has two modes: fast takes the shortest way
from the coarsest to the finest set, precise compares several.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from typing import Any

import numpy as np

from greenough.instrument.rigfile import load_rig_file
from greenough.pipeline.decode import decode
from greenough.pipeline.fringes import FringeSet
from greenough.pipeline.reconstruct import reconstruct

from . import synthetic
from .rows import Row, interleaved, limited

COPY_LIMIT = 4.0
NUMPY_LIMIT = 1 / 8
FRINGES_LIMIT = 1 / 20
POINTS_LIMIT = 2.0

NOISES_DN = (1, 3, 5, 8)
MODES = ("fast", "precise")

COPY, DECODE, POINTS = "copy the frames", "decode", "frames to points"
ESTIMATED = "decode, noise estimated from the frames"
NUMPY = "NumPy"

_NOISE_DN = 3.0
_REPEATS = 15

Decoder = Callable[[np.ndarray], np.ndarray]
"""Frames (frames, rows, cols) to absolute phase of the densest set (rows, cols), rad."""


def rows(rig_name: str, overrides: Sequence[str]) -> list[Row]:
    """Times and wrong fringe orders; without the rows of `fringes` where it is not installed."""
    rig_file = load_rig_file(rig_name, overrides)
    calibration = synthetic.calibration(rig_file)
    fringes, shape, noise = calibration.fringes, rig_file.camera.shape, rig_file.camera.noise
    peers = peers_of(fringes)

    stack = synthetic.frames(fringes, shape, _NOISE_DN)
    copy = np.empty_like(stack)
    times = interleaved(
        {
            COPY: lambda: np.copyto(copy, stack),
            DECODE: lambda: decode(stack, fringes, noise),
            ESTIMATED: lambda: decode(stack, fringes),
            POINTS: lambda: reconstruct(decode(stack, fringes, noise), calibration),
            **{name: partial(peer, stack) for name, peer in peers.items()},
        },
        _REPEATS,
    )
    limits = {NUMPY: NUMPY_LIMIT, fringes_name("fast"): FRINGES_LIMIT}
    ours = times[DECODE]
    found = [
        Row(COPY, times[COPY], "s"),
        limited(DECODE, ours, "s", COPY, ours / times[COPY], COPY_LIMIT),
        Row(ESTIMATED, times[ESTIMATED], "s", COPY, times[ESTIMATED] / times[COPY]),
        limited(POINTS, times[POINTS], "s", DECODE, times[POINTS] / ours, POINTS_LIMIT),
    ]
    for name in peers:
        ratio = ours / times[name]
        limit = limits.get(name)
        beside = f"{DECODE}, against {name}"
        found.append(
            Row(beside, ours, "s", name, ratio) if limit is None else limited(beside, ours, "s", name, ratio, limit)
        )
    for noise_dn in NOISES_DN:
        found.extend(order_rows(fringes, shape, noise_dn, peers))
    return found


def order_rows(fringes: FringeSet, shape: tuple[int, int], noise_dn: float, peers: Mapping[str, Decoder]) -> list[Row]:
    """Pixels with wrong fringe orders at a noise: ours may be no more than each peer's, which is the limit.

    We tell which pixels are not safe and leave them out; peers decode all of them. How many we leave out is a row.
    """
    stack = synthetic.frames(fringes, shape, noise_dn)
    true = synthetic.plane_phases(fringes, shape, np.zeros(1))[0]
    phase_map = decode(stack, fringes)
    ours = wrong_orders(phase_map.absolute, true)
    at = f"at a noise of {noise_dn} DN"
    return [
        Row(f"pixels left out {at}", 100 * float(1 - phase_map.valid.mean()), "%"),
        *(
            limited(
                f"wrong fringe orders {at}, against {name}", ours, "px", name, None, wrong_orders(peer(stack), true)
            )
            for name, peer in peers.items()
        ),
    ]


def wrong_orders(absolute: np.ndarray, true: np.ndarray) -> int:
    """Number of pixels whose absolute phase is nearer to another fringe; none of NaN is."""
    return int(np.count_nonzero(np.abs(absolute - true) > np.pi))


def peers_of(fringes: FringeSet) -> dict[str, Decoder]:
    """The others' decoders that are installed, by name."""
    peers: dict[str, Decoder] = {NUMPY: partial(decode_by_numpy, fringes=fringes)}
    if find_spec("fringes") is not None:
        peers |= {fringes_name(mode): decoder_of_fringes(fringes, mode) for mode in MODES}
    return peers


def fringes_name(mode: str) -> str:
    """What the rows call `fringes` in one of its modes."""
    return f"fringes, {mode}"


def decode_by_numpy(stack: np.ndarray, fringes: FringeSet) -> np.ndarray:
    """Eq. 2-5 as somebody writes them with NumPy: whole pictures at a time, in single precision."""
    absolute = modulation = np.zeros(stack.shape[1:], np.float32)
    for k, (part, steps, ratio) in enumerate(zip(fringes.slices, fringes.steps, fringes.ratios, strict=True)):
        angle = (2 * np.pi * np.arange(steps) / steps).astype(np.float32)
        frames = stack[part].astype(np.float32)
        real = np.tensordot(np.cos(angle), frames, axes=1)
        imaginary = -np.tensordot(np.sin(angle), frames, axes=1)
        modulation = 2 / steps * np.hypot(real, imaginary)
        phase = np.arctan2(imaginary, real)
        expected = ratio * absolute
        absolute = phase + 2 * np.pi * np.round((expected - phase) / (2 * np.pi)) if k else phase % (2 * np.pi)
    return np.where(modulation > 0, absolute, np.nan)


def decoder_of_fringes(fringes: FringeSet, mode: str) -> Decoder:
    """`fringes`, whose screen is as wide as the coarsest fringe; it gives columns, and compiles in its first call."""
    peers: Any = import_module("fringes")  # which need not be installed: its types are not looked at
    width = fringes.periods[0]
    peer = peers.Fringes(
        X=round(width),
        Y=1,
        axes=(1,),
        K=len(fringes.periods),
        N=(fringes.steps,),
        v=(tuple(width / period for period in fringes.periods),),
        p0=0.0,
        reverse=True,  # its frames are shifted the other way
        mode=mode,
    )

    def decoded(stack: np.ndarray) -> np.ndarray:
        _, _, column = peer.decode(stack)
        return 2 * np.pi / fringes.periods[-1] * column.reshape(stack.shape[1:])

    return decoded
