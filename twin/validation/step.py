"""A claim about a step that the stage makes, whose true height the bench knows."""

from collections.abc import Iterator, Sequence

import numpy as np

from greenough.instrument.contract import Placement

from .claims import Claim, Prediction
from .mechanics import expected_error, left_to_chance
from .planes import count, vertical_error
from .setup import Setup

STEP_MM = 2.5
LIMITS_UM = {"bundle": 0.5, "paper": 4.0}


def step_claims(setups: Sequence[Setup]) -> Iterator[Claim]:
    """The step by every calibration: the difference of the planes' mean errors."""
    setups[0].place(Placement("plane"))
    errors: list[list[np.ndarray]] = [[] for _ in setups]
    true, exposures = [], []
    for height in (-STEP_MM / 2, STEP_MM / 2):
        setups[0].rig.stage.move_to_mm(height)
        frames = setups[0].frames()
        phase_map = setups[0].decoded(frames)
        exposures.append(int(frames.serials[0]))
        true.append(setups[0].bench.world_from_part[2, 3])
        for setup, error in zip(setups, errors, strict=True):
            error.append(vertical_error(setup, setup.points(phase_map)))
    for setup, (lower, upper) in zip(setups, errors, strict=True):
        step = float(np.nanmean(upper) - np.nanmean(lower))
        yield setup.claim(
            "step_2500um", "plane", 1e3 * step, "um", count(lower) + count(upper),
            f"error of a true step of {true[1] - true[0]:.4f} mm", limit=LIMITS_UM[setup.calibration.method],
            **(_prediction(setup, np.array(true), exposures) if setup.believes_stage else Prediction()),
        )  # fmt: skip


def _prediction(setup: Setup, heights: np.ndarray, exposures: Sequence[int]) -> Prediction:
    """From stage, board and table as they are, of heights that were captured after ``exposures`` of the run."""
    low, high = expected_error(setup, heights).mean(axis=1)
    down, up = (left_to_chance(setup, np.full((1, 1), z), n)[:, 0, 0] for z, n in zip(heights, exposures, strict=True))
    return {"predicted": 1e3 * float(high - low), "predicted_sd": 1e3 * float(np.std(up - down))}
