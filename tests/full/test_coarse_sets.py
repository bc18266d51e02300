"""Why the coarser fringe sets only count fringes: what they would add to the phase, beside the noise they would take.

Of a set of N_i steps and period p_i the phase, turned into that of the densest, has N p_i² / (N_i p²) times the densest
one's variance: weighted by the inverse variances it lowers the noise a little, and shifts the phase by its weight times
what the two differ by. That difference is no noise where interreflection and blur, which act on wide fringes
differently, have drawn the wide ones: it repeats in two exposures, so that the mean product of both is free of noise.
"""

import numpy as np
import pytest

import greenough.twin as gt
from greenough.instrument.contract import Placement
from greenough.pipeline.decode import decode
from greenough.pipeline.exposure import auto_exposure, capture_bracketed
from greenough.pipeline.fringes import PAPER
from greenough.pipeline.jit import Float
from greenough.pipeline.phase_shifting import estimate_phasor
from greenough.twin.validation.measured_noise import STEADY

EQUAL_LIGHT_WEIGHT = PAPER.steps[-2] / PAPER.steps[-1] * (PAPER.periods[-1] / PAPER.periods[-2]) ** 2
"""Of the coarser set, if both have the same modulation and noise of grey values."""


def combined(frames, variance) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Shift of the densest phase, rad, by the next coarser set, the share of variance that it takes, and validity."""
    phase_map = decode(frames, PAPER, variance)
    stack = np.where(np.isfinite(frames.stack), frames.stack, 0)
    at_black, per_dn = (
        np.where(np.isfinite(v), v, 1).astype(np.float32) for v in (variance.at_black_dn2, variance.per_dn)
    )
    light = at_black + per_dn * np.maximum(stack.mean(axis=0), 0)
    coarse, dense = (
        estimate_phasor([Float(f.ravel()) for f in stack[part]], Float(light.ravel()), Float(per_dn.ravel()))
        for part in PAPER.slices[-2:]
    )
    scale = PAPER.periods[-1] / PAPER.periods[-2]
    shape = phase_map.valid.shape
    coarse_variance = np.array(coarse.variance).reshape(shape) / scale**2
    weight = np.array(dense.variance).reshape(shape)
    with np.errstate(invalid="ignore", over="ignore"):
        weight = weight / (weight + coarse_variance)
        difference = np.array(coarse.phase).reshape(shape) - scale * phase_map.absolute
        shift = weight * np.angle(np.exp(1j * difference)) / scale
    return shift, weight, phase_map.valid


@pytest.mark.parametrize("specimen", ["plane", "bga"])
def test_the_next_coarser_set_takes_a_few_per_cent_of_the_variance_and_shifts_solder(specimen, figure):
    rig, bench = gt.open("twin", STEADY, run="coarse sets")
    optics = bench.settings.optics
    period_mm = PAPER.periods[-1] * 1e-3 * optics.column_pitch_um
    mm_per_rad = period_mm / (2 * np.pi) / (2 * np.sin(np.radians(optics.convergence_deg / 2)))
    patterns = PAPER.patterns(*rig.projector.shape)
    with rig:
        rig.operator.place(Placement(specimen))
        auto_exposure(rig)
        pair = [capture_bracketed(rig, patterns, (1.0,) if specimen == "plane" else (4.0, 1.0)) for _ in range(2)]
    (first, weight, valid), (second, _, also) = (combined(merged.frames, merged.variance) for merged in pair)
    seen = valid & also
    assert np.median(weight[seen]) == pytest.approx(EQUAL_LIGHT_WEIGHT, rel=0.35)
    gain = 1 - np.sqrt(1 - np.median(weight[seen]))
    product = (first[seen] - first[seen].mean()) * (second[seen] - second[seen].mean())
    shift_um = 1e3 * mm_per_rad * float(np.sqrt(max(0.0, product.mean())))
    figure(f"{specimen}: noise less by the set of {PAPER.periods[-2]:g} columns", 100 * gain, np.inf, "%")
    figure(f"{specimen}: systematic error more by it", shift_um, np.inf, "um")
    if specimen == "bga":
        assert shift_um > 0.5
