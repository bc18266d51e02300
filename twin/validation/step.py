"""A claim about a step that the stage makes, whose true height the bench knows."""

from collections.abc import Iterator, Sequence

import numpy as np

from greenough.instrument.contract import Placement

from .claims import Claim, Prediction
from .mechanics import expected_error, field_grid, left_to_chance
from .planes import count, vertical_error
from .setup import Setup

STEP_MM = 2.5
LIMITS_UM = {"bundle": 0.5, "paper": 4.0}


def step_claims(setups: Sequence[Setup]) -> Iterator[Claim]:
    """The step by every calibration: the difference of the planes' mean errors."""
    setups[0].place(Placement("plane"))
    errors: list[list[np.ndarray]] = [[] for _ in setups]
    true = []
    for height in (-STEP_MM / 2, STEP_MM / 2):
        setups[0].rig.stage.move_to_mm(height)
        phase_map = setups[0].capture()
        true.append(setups[0].bench.world_from_part[2, 3])
        for setup, error in zip(setups, errors, strict=True):
            error.append(vertical_error(setup, setup.points(phase_map)))
    for setup, (lower, upper) in zip(setups, errors, strict=True):
        step = float(np.nanmean(upper) - np.nanmean(lower))
        yield setup.claim(
            "step_2500um", "plane", 1e3 * step, "um", count(lower) + count(upper),
            f"error of a true step of {true[1] - true[0]:.4f} mm", limit=LIMITS_UM[setup.calibration.method],
            **(_prediction(setup, np.array(true)) if setup.believes_stage else Prediction()),
        )  # fmt: skip


def _prediction(setup: Setup, heights: np.ndarray) -> Prediction:
    """From stage, board and table as they are."""
    low, high = expected_error(setup, heights).mean(axis=1)
    chance = left_to_chance(setup, np.tile(heights[:, None], len(field_grid()))).mean(axis=2)  # (draws, 2)
    return {"predicted": 1e3 * float(high - low), "predicted_sd": 1e3 * float(np.std(chance[:, 1] - chance[:, 0]))}
