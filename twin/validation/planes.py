"""Claims about planes: noise, depth over the volume, its extent, and a step made by the stage."""

from collections.abc import Iterator

import numpy as np

from greenough.instrument.contract import Placement
from greenough.pipeline.reconstruct import PointMap

from .claims import Claim
from .setup import Setup

VOLUME_HEIGHTS_MM = (-1.48, -1.0, -0.5, 0.0, 0.5, 1.0, 1.48)
"""Stage positions between the calibration's heights, which are odd multiples of 0.05 mm; the ends reach past them."""

NOISE_HEIGHT_MM = 0.1
STEP_MM = 2.5
PAPER_LINE = 330  # the row whose profile the paper shows
CALIBRATION_VARIANCE_SHARE = 0.27**2
"""Variance of a four-parameter fit to 30 planes in the middle of its range, over that of one measurement."""


def vertical_error(setup: Setup, points: PointMap) -> np.ndarray:
    """z of each point minus the mounted plane's z on the same (x, y), (rows, cols) mm."""
    world_from_part = setup.bench.world_from_part
    normal, origin = world_from_part[:3, 2], world_from_part[:3, 3]
    return (points.xyz - origin) @ normal / normal[2]


def noise_claims(setup: Setup) -> Iterator[Claim]:
    """What one and two exposures of a plane scatter by, about the best plane through them."""
    setup.place(Placement("plane"), NOISE_HEIGHT_MM)
    first, second = setup.capture(), setup.capture()
    raw = _without_plane(setup, setup.points(first))
    n = int(np.isfinite(raw).sum())
    predicted = _rms(setup.height_sigma(first)[np.isfinite(raw)]) * np.sqrt(1 + CALIBRATION_VARIANCE_SHARE)
    yield setup.claim(
        "plane_rmse_raw", "plane", 1e3 * _rms(raw), "um", n, "root mean square about the best plane, one exposure",
        paper=1.223, limit=1.223, expected_to_hold=False, alignment="best plane", predicted=1e3 * predicted,
    )  # fmt: skip
    yield setup.claim(
        "plane_within_5um", "plane", float(np.mean(np.abs(raw[np.isfinite(raw)]) <= 5e-3)), "1", n,
        "share of departures from the best plane within 5 um is at least 0.95",
        limit=0.95, holds=bool(np.nanmean(np.abs(raw[np.isfinite(raw)]) <= 5e-3) >= 0.95), alignment="best plane",
    )  # fmt: skip
    line = raw[min(PAPER_LINE, raw.shape[0] - 1)]
    line = line[np.isfinite(line)]
    yield setup.claim(
        "plane_line_noise", "plane", 1e3 * float(np.percentile(np.abs(line), 95)), "um", len(line),
        f"95 % of the departures along image row {PAPER_LINE}", paper=4.0, limit=4.0, alignment="best plane",
    )  # fmt: skip
    two = _without_plane(setup, PointMap((setup.points(first).xyz + setup.points(second).xyz) / 2))
    yield setup.claim(
        "plane_rmse_two_exposures", "plane", 1e3 * _rms(two), "um", int(np.isfinite(two).sum()),
        "root mean square about the best plane of two exposures' mean", paper=1.223, limit=1.223,
        filter="mean of two exposures", alignment="best plane",
    )  # fmt: skip
    smooth = _without_plane(setup, setup.filtered_points(first))
    yield setup.claim(
        "plane_rmse_filtered", "plane", 1e3 * _rms(smooth), "um", int(np.isfinite(smooth).sum()),
        "root mean square about the best plane, one exposure", paper=1.223, limit=1.223,
        filter=setup.filter_name, alignment="best plane",
    )  # fmt: skip


def volume_claims(setup: Setup, advance) -> Iterator[Claim]:
    """Depth error over the volume, and how large that volume is."""
    errors, spans, heights = [], [], []
    setup.place(Placement("plane"))
    for height in VOLUME_HEIGHTS_MM:
        setup.rig.stage.move_to_mm(height)
        points = setup.filtered_points(setup.capture())
        errors.append(vertical_error(setup, points)[points.valid])
        spans.append(_covered(points))
        heights.append(setup.bench.world_from_part[2, 3])
        advance(1)
    together = np.abs(np.concatenate(errors))
    yield setup.claim(
        "depth_p95_volume", "plane", 1e3 * float(np.percentile(together, 95)), "um", len(together),
        f"95 % of the vertical errors at {len(heights)} heights between the calibration's", paper=4.0, limit=4.0,
        filter=setup.filter_name,
    )  # fmt: skip
    for height, error in zip(heights, errors, strict=True):
        yield setup.claim(
            f"depth_bias_at_{height:+.1f}mm", "plane", 1e3 * float(np.mean(error)), "um", len(error),
            "mean vertical error: the stage's error goes into it", filter=setup.filter_name,
        )  # fmt: skip
    low, high = np.max([s[0] for s in spans], axis=0), np.min([s[1] for s in spans], axis=0)
    board, depth = setup.calibration.board.size_mm, heights[-1] - heights[0]
    lean = np.tan(np.radians(setup.bench.settings.optics.convergence_deg / 2))
    # The blank side as seen by a camera that leans shifts over the depth: that much less is covered at all heights.
    across = board - lean * depth
    yield setup.claim(
        "volume_x", "plane", high[0] - low[0], "mm", len(spans),
        f"width measured at all heights is at least 0.98 of {across:.2f} mm, the board less its parallax", paper=8.0,
        limit=0.98 * across, holds=bool(high[0] - low[0] >= 0.98 * across), predicted=across,
    )  # fmt: skip
    yield setup.claim(
        "volume_y", "plane", high[1] - low[1], "mm", len(spans), "length measured at all heights is at least 5.9 mm",
        paper=6.0, limit=5.9, holds=bool(high[1] - low[1] >= 5.9),
    )  # fmt: skip
    yield setup.claim(
        "z_range", "plane", depth, "mm", len(heights), "true distance of the outermost planes is at least 2.9 mm",
        paper=3.0, limit=2.9, holds=bool(depth >= 2.9),
    )  # fmt: skip


def step_claims(setup: Setup) -> Iterator[Claim]:
    """A step of 2.5 mm, made by the stage and known to the bench."""
    setup.place(Placement("plane"))
    mean, true, n = [], [], 0
    for height in (-STEP_MM / 2, STEP_MM / 2):
        setup.rig.stage.move_to_mm(height)
        error = vertical_error(setup, setup.points(setup.capture()))
        mean.append(float(np.nanmean(error)))
        n += int(np.isfinite(error).sum())
        true.append(setup.bench.world_from_part[2, 3])
    planes, step = setup.calibration.procedure.planes, setup.calibration.procedure.plane_step_mm
    spread = step * np.sqrt((planes**2 - 1) / 12)
    scale_sd = setup.bench.settings.stage.position_sd_um / (np.sqrt(planes) * spread)  # um per mm
    yield setup.claim(
        "step_2500um", "plane", 1e3 * (mean[1] - mean[0]), "um", n,
        f"error of a true step of {true[1] - true[0]:.4f} mm; the stage's error predicts its standard deviation",
        limit=4.0, predicted=float(scale_sd * STEP_MM),
    )  # fmt: skip


def _without_plane(setup: Setup, points: PointMap) -> np.ndarray:
    """Vertical departures from the best plane, (rows, cols) mm."""
    error = vertical_error(setup, points)
    valid = np.isfinite(error)
    design = np.column_stack([np.ones(valid.sum()), points.xyz[valid][:, :2]])
    error[valid] -= design @ np.linalg.lstsq(design, error[valid], rcond=None)[0]
    return error


def _covered(points: PointMap) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest x and y that are measured along the middle of the field, (2,) each, mm."""
    xyz = points.xyz[points.valid]
    along_x, along_y = xyz[np.abs(xyz[:, 1]) < 0.5, 0], xyz[np.abs(xyz[:, 0]) < 0.5, 1]
    return np.array([along_x.min(), along_y.min()]), np.array([along_x.max(), along_y.max()])


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.nanmean(np.square(values))))
