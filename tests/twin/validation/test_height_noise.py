"""Predicted noise of heights against frames with simulated noise, through the pipeline's own decoder.

Of each effect 60 exposures are simulated. Shot noise, read noise and quantisation are independent in 60 x 1200 pixels,
whose scatter is then known to 0.3 %. Flicker and vibration have one number per frame: the mean square over 60 exposures
of what 12 of them leave is known to about sqrt(2 / 11 / 60) = 5.5 %. Bounds are four standard deviations.
"""

from types import SimpleNamespace

import numpy as np
import pytest

from greenough.instrument.contract import CameraNoise
from greenough.pipeline.decode import decode
from greenough.pipeline.fringes import FringeSet
from greenough.twin.settings import TwinSettings
from greenough.twin.validation.height_noise import phase_shares, predicted_noise
from greenough.twin.validation.setup import Setup

FRINGES = FringeSet((608, 152, 40, 12), (4, 4, 4, 12))
CAMERA = CameraNoise(6500.0, 10.0, 6500.0 / 251)
MM_PER_RAD = 0.16
SHAPE = (20, 60)
EXPOSURES = 60
OFF = {
    "camera": {"shot_noise": False, "read_noise_e": 0.0},
    "stability": {"flicker": 0.0, "vibration_um": 0.0},
}


def twin(section: str | None = None, **sizes: float) -> Setup:
    """A setup that turns phase into height by a constant, and of all noise has only the given sizes."""
    chosen = {name: values | (sizes if name == section else {}) for name, values in OFF.items()}
    relation = SimpleNamespace(
        height=lambda phase: MM_PER_RAD * phase, slope=lambda phase: np.full_like(phase, MM_PER_RAD, dtype=float)
    )
    rig = SimpleNamespace(camera=SimpleNamespace(noise=CAMERA), procedure=SimpleNamespace(steps=FRINGES.steps))
    bench = SimpleNamespace(settings=TwinSettings.model_validate(chosen))
    return Setup(rig, bench, SimpleNamespace(phase_height=relation))


def heights(
    rng: np.random.Generator,
    shot: bool = False,
    read_e: float = 0.0,
    quantised: bool = False,
    flicker: float = 0.0,
    raised_mm: float = 0.0,
):
    """Heights (exposures, rows, cols) from simulated frames, and the phase map of one exposure."""
    column = np.linspace(200, 300, SHAPE[0] * SHAPE[1]).reshape(SHAPE)  # 8 fringes
    measured = []
    for _ in range(EXPOSURES):
        moved = rng.normal(0, raised_mm, FRINGES.steps[-1]) / MM_PER_RAD  # rad of the densest fringes, of each frame
        lights = []
        for period, steps in zip(FRINGES.periods, FRINGES.steps, strict=True):
            shift = moved if steps == 12 else np.zeros(steps)
            for n in range(steps):
                angle = 2 * np.pi * (column / period + n / steps) + shift[n]
                lights.append((100 + 78 * np.cos(angle)) * (1 + rng.normal(0, flicker)))
        grey = np.array(lights)
        if shot:
            grey = rng.poisson(grey * CAMERA.electrons_per_dn) / CAMERA.electrons_per_dn
        grey = grey + rng.normal(0, read_e / CAMERA.electrons_per_dn, grey.shape)
        stack = np.rint(grey).astype(np.uint8) if quantised else grey.astype(np.float32)
        phase_map = decode(stack, FRINGES, CAMERA)
        measured.append(MM_PER_RAD * phase_map.absolute.astype(np.float64))
    return np.array(measured), phase_map


@pytest.mark.parametrize(
    ("simulated", "setup", "bound"),
    [
        ({"shot": True}, twin("camera", shot_noise=True), 0.012),
        ({"read_e": 10.0}, twin("camera", read_noise_e=10.0), 0.012),
        ({"read_e": 10.0, "quantised": True}, twin("camera", read_noise_e=10.0), 0.012),
        ({"flicker": 0.01}, twin("stability", flicker=0.01), 0.11),
        ({"raised_mm": 0.002}, twin("stability", vibration_um=2.0), 0.11),
    ],
    ids=["shot", "read", "quantised", "flicker", "vibration"],
)
def test_noise_is_what_simulated_frames_scatter_by(simulated, setup, bound):
    measured, phase_map = heights(np.random.default_rng(1), **simulated)
    common = measured.mean(axis=(1, 2), keepdims=True) if "raised_mm" in simulated or "flicker" in simulated else 0
    deviations = measured - common - (measured - common).mean(axis=0)
    scatter = np.sqrt(np.sum(deviations**2) / (EXPOSURES - 1) / deviations[0].size)
    expected = predicted_noise(setup, phase_map, simulated.get("quantised", False))
    assert scatter == pytest.approx(expected, rel=bound)


def test_nothing_on_is_no_noise():
    _, phase_map = heights(np.random.default_rng(1))
    assert predicted_noise(twin(), phase_map, False) == 0


def test_equal_weights_are_the_papers_formula():
    """Eq. 2: the phase changes by -2 sin(angle) / (N B) with each grey value."""
    angle = np.array([[0.3], [2.0]]) + 2 * np.pi * np.arange(12) / 12
    modulation = np.array([50.0, 80.0])
    shares = phase_shares(modulation, angle, np.full(angle.shape, 7.0))
    np.testing.assert_allclose(shares, -2 * np.sin(angle) / (12 * modulation[:, None]), atol=1e-15)
