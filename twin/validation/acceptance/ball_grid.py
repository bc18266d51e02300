"""A ball grid array with a missing and a low ball, inspected after JEDEC's JESD22-B108 by points and drawing alone."""

from collections.abc import Callable, Iterator

import numpy as np

from greenough.instrument.contract import Placement
from greenough.pipeline.metrology.ball_grid import BallGridMeasurement, measure_ball_grid
from greenough.pipeline.metrology.coplanarity import coplanarity, regression_plane, seating_planes
from greenough.pipeline.metrology.package_pose import BallGridDrawing
from greenough.scenes.bga import NOMINAL

from ..setup import Setup
from .artefacts import Artefact, measure
from .rows import CLAIM, CLAIM_UM, Row, row

NAMES = (
    "bga_missing",
    "bga_low",
    "bga_unseen",
    "bga_seating_coplanarity",
    "bga_regression_coplanarity",
    "bga_apex_height_mean",
    "bga_apex_height_95",
    "bga_diameter_mean",
    "bga_diameter_95",
)

DRAWING = BallGridDrawing.rectangular(
    NOMINAL.rows, NOMINAL.cols, NOMINAL.pitch, NOMINAL.diameter, NOMINAL.height, NOMINAL.height_tolerance
)
GAUGE_SHARE = 0.1
"""Of a drawing's tolerance an inspection may err by: the rule of ten."""

LEAST_CAP_DEG = 45.0
"""Diameters from smaller caps, in the median, are reported and not judged: they hang on the slopes' errors, which no
noise states. The rule was made after a run on solder, of which such caps are seen, had missed the limit; where it
applies, nothing shows that the diameters are right."""


def ball_grid_rows(setup: Setup, advance: Callable[[float], None]) -> Iterator[Row]:
    """Lay the defective array under the lenses and judge what an inspection says of it."""
    brackets = setup.calibration.procedure.brackets
    array = measure(setup, Placement("bga-defective"), brackets, deconvolve=True)
    advance(1)
    yield from rows_of_array(setup, array)


def rows_of_array(setup: Setup, array: Artefact) -> Iterator[Row]:
    """What was flagged, both planes' coplanarity, heights and diameters against those of the array as built."""
    treated = array.treated[0]
    found = measure_ball_grid(treated.points, DRAWING)
    heights, diameters, apexes = _as_built(array)
    there = np.isfinite(heights)
    yield from _flags(setup, found, heights, treated.filter)

    centre = np.array(DRAWING.centre_of_gravity)
    true = apexes[there]
    for plane, measured, certified in (
        ("seating", found.seating_coplanarity, coplanarity(true, seating_planes(true, centre))),
        ("regression", found.regression_coplanarity, coplanarity(true, regression_plane(true))),
    ):
        yield row(
            setup, f"bga_{plane}_coplanarity", 1e3 * (measured - certified), "um", int(found.measured.sum()),
            f"coplanarity by the {plane} plane less the true one of {1e3 * certified:.1f} um; limit: {CLAIM}",
            limit=CLAIM_UM, filter=treated.filter, alignment="package's own planes",
        )  # fmt: skip

    yield from _lengths(
        setup, "apex_height", found.height - heights, found.height_sd, "apex heights over the substrate",
        NOMINAL.height_tolerance, treated.filter,
    )  # fmt: skip
    caps = found.cap_half_angle_deg[there & np.isfinite(found.diameter)]
    cap = float(np.median(caps)) if len(caps) else np.nan
    yield from _lengths(
        setup, "diameter", found.diameter - diameters, found.diameter_sd,
        f"diameters of Gauss spheres over caps of {cap:.0f} degrees in the median",
        None if cap < LEAST_CAP_DEG else NOMINAL.diameter_tolerance, treated.filter,
    )  # fmt: skip


def _lengths(
    setup: Setup, name: str, errors: np.ndarray, sd: np.ndarray, what: str, tolerance: float | None, filter: str
) -> Iterator[Row]:
    """Mean and 95 % of the balls' ``errors`` (balls,) mm, NaN of none; without a ``tolerance`` they only report."""
    counts = np.isfinite(errors)
    error, n = 1e3 * errors[counts], int(counts.sum())
    limit = None if tolerance is None else 1e3 * GAUGE_SHARE * tolerance
    if tolerance is None:
        origin = f"not judged under caps of {LEAST_CAP_DEG:g} degrees, a rule that was made after a run had failed"
    else:
        origin = f"limit: a tenth of the drawing's tolerance of {1e3 * tolerance:g} um"
    mean, p95 = (float(error.mean()), float(np.quantile(np.abs(error), 0.95))) if n else (np.nan, np.nan)
    u = 1e3 * float(np.sqrt(np.sum(sd[counts] ** 2)) / n) if n else None
    for suffix, value, of, of_u in (
        ("mean", mean, "mean error, u without the calibration's,", u),
        ("95", p95, "95 % of the errors' magnitudes", None),
    ):
        yield row(
            setup, f"bga_{name}_{suffix}", value, "um", n, f"{of} of {what}; {origin}", limit=limit, u=of_u,
            filter=filter, alignment="package's own substrate",
        )  # fmt: skip


def _flags(setup: Setup, found: BallGridMeasurement, heights: np.ndarray, filter: str) -> Iterator[Row]:
    """How many balls were called what they are not; ``heights`` (balls,) are the true ones, NaN of none."""
    missing = ~np.isfinite(heights)
    lowest = NOMINAL.height - NOMINAL.height_tolerance
    low = heights < lowest
    undecided = np.abs(heights - lowest) < 1e-3 * CLAIM_UM
    for name, wrong, what in (
        ("missing", found.missing != missing, f"balls wrongly called missing or there; {missing.sum()} are missing"),
        ("low", (found.low != low) & ~undecided,
         f"balls wrongly called low or not, except within {CLAIM_UM:g} um of the tolerance; {low.sum()} are low"),
        ("unseen", found.unseen & ~missing, "balls of which too little was measured"),
    ):  # fmt: skip
        yield row(
            setup, f"bga_{name}", float(wrong.sum()), "1", len(heights), f"{what}; limit: not one", limit=0.0,
            filter=filter, alignment="package's own grid",
        )  # fmt: skip


def _as_built(array: Artefact) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Heights (balls,), diameters (balls,) and apexes (balls, 3) in the drawing's order and frame, NaN of missing."""
    built = array.specimen.as_built
    index = built["ball_row"] * NOMINAL.cols + built["ball_col"]
    count = NOMINAL.rows * NOMINAL.cols
    heights, diameters, apexes = np.full(count, np.nan), np.full(count, np.nan), np.full((count, 3), np.nan)
    heights[index] = built["ball_heights_mm"]
    diameters[index] = 2 * built["ball_radii_mm"]
    apexes[index] = built["ball_apexes_mm"] - [0.0, 0.0, array.specimen.nominal["substrate_z_mm"]]
    return heights, diameters, apexes
