"""Amplification and linearity of z by a step gauge: each step after ISO 5436-1, the line after ISO 25178-600."""

from collections.abc import Callable, Iterator, Sequence

import numpy as np

from greenough.instrument.contract import Placement
from greenough.pipeline.metrology.amplification import amplification
from greenough.pipeline.metrology.step_height import StepHeight, groove_sides, step_height
from greenough.scenes.step_gauge import GROOVES_MM, RIDGES_MM

from ..setup import Setup
from .artefacts import Artefact, Measurand, calibration_sd, measure
from .rows import CLAIM, CLAIM_UM, Row, row

STEPS = tuple(
    f"{1e3 * abs(height):.0f}um_{'ridge' if height > 0 else 'groove'}" for height in (*RIDGES_MM, *GROOVES_MM)
)
NAMES = (*(f"step_{step}" for step in STEPS), "step_largest", "alpha_z", "linearity_z")

RANGE_MM = 3.0
"""Of heights that the claim is made for."""

ALIGNMENT = "levelled on both plateaus, windows by the gauge's true place"
_FROM_ENDS_MM = 0.3  # of the lanes, where other walls are near


def step_rows(setup: Setup, advance: Callable[[float], None]) -> Iterator[Row]:
    """Lay the step gauge under the lenses and judge its steps."""
    gauge = measure(setup, Placement("step-gauge"))
    advance(1)
    yield from rows_of_gauge(setup, gauge)


def rows_of_gauge(setup: Setup, gauge: Artefact) -> Iterator[Row]:
    """Every step's error, the largest, and the line through all."""
    certified = gauge.specimen.as_built["step_heights_mm"]
    boxes = gauge.specimen.as_built["step_boxes_mm"]
    where = gauge.judged & gauge.raw.valid
    true, points = gauge.in_part(gauge.truth.xyz_world), gauge.in_part(gauge.raw.xyz)
    steps, all_sides = [], []
    for name, height, box in zip(STEPS, certified, boxes, strict=True):
        sides = np.where(where & _in_lane(true, box[1]), groove_sides(true[..., 0], (box[0, 0], box[0, 1])), 0)
        counts = sides != 0
        step = _step(points[counts], sides[counts])
        steps.append(step)
        all_sides.append(sides)
        by_calibration = calibration_sd(_height(gauge, sides), gauge.raw, counts)
        yield row(
            setup, f"step_{name}", -1e3 * (step.height + height), "um", step.n,
            f"height of a step certified as {1e3 * height:.2f} um, less that; limit: {CLAIM}",
            limit=CLAIM_UM, u=1e3 * float(np.hypot(step.sd, by_calibration)), alignment=ALIGNMENT,
        )  # fmt: skip
    measured = np.array([-step.height for step in steps])
    errors, n = 1e3 * (measured - certified), sum(step.n for step in steps)
    yield row(
        setup, "step_largest", errors[np.argmax(np.abs(errors))], "um", len(errors),
        f"the error of the largest magnitude of {len(errors)} steps; limit: {CLAIM}", limit=CLAIM_UM,
        alignment=ALIGNMENT,
    )  # fmt: skip
    line = amplification(certified, measured)
    anywhere = np.any([sides != 0 for sides in all_sides], axis=0)
    by_calibration = calibration_sd(_alpha(gauge, all_sides, certified), gauge.raw, anywhere)
    span = f"{line.span[0]:+.2f} to {line.span[1]:+.2f} mm"
    yield row(
        setup, "alpha_z", line.alpha, "1", line.n,
        f"slope of measured over certified heights from {span}; peer: 1; what must keep to the limit is its difference "
        f"from 1: {CLAIM} over the range of {RANGE_MM:g} mm",
        limit=1e-3 * CLAIM_UM / RANGE_MM, judged=line.alpha - 1, peer=1.0,
        u=float(np.hypot(line.alpha_sd, by_calibration)), alignment=ALIGNMENT,
    )  # fmt: skip
    yield row(
        setup, "linearity_z", 1e3 * line.linearity, "um", n,
        f"largest departure of a step's height from that line; limit: {CLAIM}", limit=CLAIM_UM, alignment=ALIGNMENT,
    )  # fmt: skip


def _in_lane(points: np.ndarray, lane: np.ndarray) -> np.ndarray:
    return (points[..., 1] > lane[0] + _FROM_ENDS_MM) & (points[..., 1] < lane[1] - _FROM_ENDS_MM)


def _step(points: np.ndarray, sides: np.ndarray) -> StepHeight:
    return step_height(points[:, :2], points[:, 2], sides)


def _height(gauge: Artefact, sides: np.ndarray) -> Measurand:
    """Height of a step from points of the calibrated frame and the flat indices of their pixels."""
    return lambda xyz, pixels: _step(gauge.in_part(xyz), sides.ravel()[pixels]).height


def _alpha(gauge: Artefact, all_sides: Sequence[np.ndarray], certified: np.ndarray) -> Measurand:
    """Slope of measured over certified heights from the same, ``all_sides`` of each step."""
    heights = [_height(gauge, sides) for sides in all_sides]
    return lambda xyz, pixels: amplification(certified, np.array([-of(xyz, pixels) for of in heights])).alpha
