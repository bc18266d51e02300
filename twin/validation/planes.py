"""Claims about planes: noise, depth over the volume, its extent, and a step made by the stage."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.special import erf

from greenough.instrument.contract import Placement
from greenough.pipeline.decode import PhaseMap
from greenough.pipeline.phasor_filter import filter_phasors
from greenough.pipeline.reconstruct import PointMap

from .claims import Claim
from .mechanics import field_grid, flatness_error, percentile_with_noise, systematic_error
from .setup import Setup

VOLUME_HEIGHTS_MM = (-1.48, -1.0, -0.5, 0.0, 0.5, 1.0, 1.48)
"""Stage positions between the calibration's heights, which are odd multiples of 0.05 mm; the ends reach past them."""

NOISE_HEIGHT_MM = 0.1
STEP_MM = 2.5
BLOCK_PX = 16  # noise of 2 um becomes 0.1 um in the mean of a block
SYSTEMATIC_LIMITS_UM = (0.5, 1.5)  # root mean square, and for 99 %
PAPER_LINE, PAPER_ROWS = 330, 960  # the row whose profile the paper shows, and of how many
CALIBRATION_SD_SHARE = (0.27, 0.37)
"""Standard deviation of a four-parameter fit to 30 planes over that of one measurement: in the middle of its range, and
over the range (least squares with the design matrix of a cubic). It is a pattern that no filter takes out of z. The
bundle fits no relation to single pixels and has no such pattern."""


def paper_line(rows: int) -> int:
    """The row of a picture of ``rows`` rows where the paper's profile lies."""
    return PAPER_LINE * rows // PAPER_ROWS


def vertical_error(setup: Setup, points: PointMap) -> np.ndarray:
    """z of each point minus the mounted plane's z on the same (x, y), (rows, cols) mm."""
    world_from_part = setup.bench.world_from_part
    normal, origin = world_from_part[:3, 2], world_from_part[:3, 3]
    return (points.xyz - origin) @ normal / normal[2]


@dataclass(frozen=True, eq=False)
class PlaneNoise:
    """Departures of a plane's points from their best plane, and the scatter that the frames' noise predicts.

    Parameters
    ----------
    raw, two_exposures, filtered : (rows, cols) float64
        Of one exposure, of the mean of two, and of the first one filtered; mm, NaN without a point.
    noise, filtered_noise : float
        Predicted for one exposure, mm.
    """

    raw: np.ndarray
    two_exposures: np.ndarray
    filtered: np.ndarray
    noise: float
    filtered_noise: float


def measure_plane(setups: Sequence[Setup]) -> list[PlaneNoise]:
    """Capture a plane twice, and evaluate it by every calibration."""
    setups[0].place(Placement("plane"), NOISE_HEIGHT_MM)
    first, second = setups[0].capture(), setups[0].capture()
    smoother = filter_phasors(first, setups[0].filter_fwhm_px)
    return [_plane_noise(setup, first, second, smoother) for setup in setups]


def _plane_noise(setup: Setup, first: PhaseMap, second: PhaseMap, smoother: PhaseMap) -> PlaneNoise:
    raw = _without_plane(setup, setup.points(first))
    return PlaneNoise(
        raw=raw,
        two_exposures=_without_plane(setup, PointMap((setup.points(first).xyz + setup.points(second).xyz) / 2)),
        filtered=_without_plane(setup, setup.points(smoother)),
        noise=_rms(setup.height_sigma(first)[np.isfinite(raw)]),
        filtered_noise=_rms(setup.height_sigma(smoother)[np.isfinite(raw)]),
    )


def noise_claims(setup: Setup, plane: PlaneNoise) -> Iterator[Claim]:
    """What one and two exposures of a plane scatter by, about the best plane through them.

    Predicted from the frames' noise, the calibration's, and the shape that the calibration took for flat.
    """
    raw, two, filtered, noise = plane.raw, plane.two_exposures, plane.filtered, plane.noise
    line = raw[paper_line(len(raw))]
    line = line[np.isfinite(line)]
    shape = flatness_error(_expected_error(setup, np.array([NOISE_HEIGHT_MM]))[0])
    fixed = CALIBRATION_SD_SHARE[0] * noise if setup.believes_stage else 0.0

    def predicted(measurement: float) -> float:
        return 1e3 * float(np.sqrt(shape**2 + measurement**2 + fixed**2))

    rmse = "root mean square about the best plane"
    yield setup.claim(
        "plane_rmse_raw", "plane", 1e3 * _rms(raw), "um", _count(raw), f"{rmse}, one exposure",
        paper=1.223, limit=1.223, alignment="best plane", predicted=predicted(noise),
    )  # fmt: skip
    yield setup.claim(
        "plane_rmse_two_exposures", "plane", 1e3 * _rms(two), "um", _count(two), f"{rmse}, two exposures",
        paper=1.223, limit=1.223, filter="mean of two exposures", alignment="best plane",
        predicted=predicted(noise / np.sqrt(2)),
    )  # fmt: skip
    yield setup.claim(
        "plane_rmse_filtered", "plane", 1e3 * _rms(filtered), "um", _count(filtered), f"{rmse}, one exposure",
        paper=1.223, limit=1.223, filter=setup.filter_name, alignment="best plane",
        predicted=predicted(plane.filtered_noise),
    )  # fmt: skip
    within = float(np.mean(np.abs(raw[np.isfinite(raw)]) <= 5e-3))
    expected = float(erf(5 / predicted(noise) / np.sqrt(2)))
    yield setup.claim(
        "plane_within_5um", "plane", within, "1", _count(raw), "share of departures within 5 um is at least 0.95",
        limit=0.95, holds=within >= 0.95, expected_to_hold=expected >= 0.95, alignment="best plane", predicted=expected,
    )  # fmt: skip
    yield setup.claim(
        "plane_line_noise", "plane", 1e3 * float(np.percentile(np.abs(line), 95)), "um", len(line),
        f"95 % of the departures along image row {paper_line(len(raw))}", paper=4.0, limit=4.0, alignment="best plane",
        predicted=1.96 * predicted(noise),
    )  # fmt: skip


@dataclass
class Volume:
    """What planes at several heights gave: errors of their points and what they cover, a height after the other."""

    errors: list[np.ndarray] = field(default_factory=list)  # (points,) mm
    blocks: list[np.ndarray] = field(default_factory=list)  # (blocks, 3): x, y and error of unfiltered points, mm
    spans: list[tuple[np.ndarray, np.ndarray]] = field(default_factory=list)
    heights: list[float] = field(default_factory=list)  # true, of the planes' middles
    noise: list[float] = field(default_factory=list)  # predicted for one exposure, mm
    filtered_noise: list[float] = field(default_factory=list)


def measure_volume(setups: Sequence[Setup], advance: Callable[[float], None]) -> list[Volume]:
    """Capture a plane at heights between the calibration's, and evaluate each by every calibration."""
    volumes = [Volume() for _ in setups]
    setups[0].place(Placement("plane"))
    for height in VOLUME_HEIGHTS_MM:
        setups[0].rig.stage.move_to_mm(height)
        phase_map = setups[0].capture()
        filtered = filter_phasors(phase_map, setups[0].filter_fwhm_px)
        for setup, volume in zip(setups, volumes, strict=True):
            points = setup.points(filtered)
            volume.errors.append(vertical_error(setup, points)[points.valid])
            unfiltered = setup.points(phase_map)
            volume.blocks.append(_block_means(unfiltered.xyz[..., :2], vertical_error(setup, unfiltered)))
            volume.spans.append(_covered(points))
            volume.heights.append(setup.bench.world_from_part[2, 3])
            volume.noise.append(_rms(setup.height_sigma(phase_map)[points.valid]))
            volume.filtered_noise.append(_rms(setup.height_sigma(filtered)[points.valid]))
        advance(1)
    return volumes


def volume_claims(setup: Setup, volume: Volume) -> Iterator[Claim]:
    """Depth error over the volume, and how large that volume is."""
    heights = volume.heights
    systematic = _expected_error(setup, np.array(heights))
    fixed = CALIBRATION_SD_SHARE[1] * _rms(np.array(volume.noise)) if setup.believes_stage else 0.0
    sigma = float(np.hypot(_rms(np.array(volume.filtered_noise)), fixed))
    together = np.abs(np.concatenate(volume.errors))
    yield setup.claim(
        "depth_p95_volume", "plane", 1e3 * float(np.percentile(together, 95)), "um", len(together),
        f"95 % of the vertical errors at {len(heights)} heights between the calibration's", paper=4.0, limit=4.0,
        filter=setup.filter_name, predicted=1e3 * percentile_with_noise(systematic, sigma, 0.95),
    )  # fmt: skip
    yield from _systematic_claims(setup, volume, systematic)
    for height, error, expected in zip(heights, volume.errors, systematic.mean(axis=1), strict=True):
        yield setup.claim(
            f"depth_bias_at_{height:+.1f}mm", "plane", 1e3 * float(np.mean(error)), "um", len(error),
            "mean vertical error; predicted from stage and board as built", filter=setup.filter_name,
            predicted=1e3 * float(expected),
        )  # fmt: skip
    low, high = np.max([s[0] for s in volume.spans], axis=0), np.min([s[1] for s in volume.spans], axis=0)
    board, depth = setup.calibration.board.size_mm, heights[-1] - heights[0]
    lean = np.tan(np.radians(setup.bench.settings.optics.convergence_deg / 2))
    # The blank side as seen by a camera that leans shifts over the depth: that much less is covered at all heights.
    across = board - lean * depth
    width, length = high - low
    yield setup.claim(
        "volume_x", "plane", width, "mm", len(heights),
        f"width measured at all heights is at least 0.96 of {across:.2f} mm, the board less its parallax", paper=8.0,
        limit=0.96 * across, holds=width >= 0.96 * across, predicted=across,
    )  # fmt: skip
    yield setup.claim(
        "volume_y", "plane", length, "mm", len(heights), "length measured at all heights is at least 5.9 mm",
        paper=6.0, limit=5.9, holds=length >= 5.9,
    )  # fmt: skip
    yield setup.claim(
        "z_range", "plane", depth, "mm", len(heights), "true distance of the outermost planes is at least 2.9 mm",
        paper=3.0, limit=2.9, holds=depth >= 2.9,
    )  # fmt: skip


def _systematic_claims(setup: Setup, volume: Volume, systematic: np.ndarray) -> Iterator[Claim]:
    """What is left when noise is averaged out, beside the best rigid motion of the whole volume."""
    blocks = np.concatenate(volume.blocks)
    offset, error = _without_rigid(blocks[:, :2], blocks[:, 2])
    grid = np.tile(field_grid(), (len(systematic), 1))
    _, expected = _without_rigid(grid, systematic.ravel())
    averaged = f"mean over blocks of {BLOCK_PX} x {BLOCK_PX} px"
    frame = "best height and tilt"
    yield setup.claim(
        "depth_origin", "plane", 1e3 * offset, "um", len(blocks), "mean vertical error over all heights",
        filter=averaged, predicted=1e3 * float(systematic.mean()),
    )  # fmt: skip
    yield setup.claim(
        "depth_systematic_rms", "plane", 1e3 * _rms(error), "um", len(blocks),
        "root mean square vertical error over all heights", limit=SYSTEMATIC_LIMITS_UM[0], filter=averaged,
        alignment=frame, predicted=1e3 * _rms(expected),
    )  # fmt: skip
    yield setup.claim(
        "depth_systematic_p99", "plane", 1e3 * float(np.percentile(np.abs(error), 99)), "um", len(blocks),
        "99 % of the vertical errors over all heights", limit=SYSTEMATIC_LIMITS_UM[1], filter=averaged,
        alignment=frame, predicted=1e3 * float(np.percentile(np.abs(expected), 99)),
    )  # fmt: skip


def step_claims(setups: Sequence[Setup]) -> Iterator[Claim]:
    """A step of 2.5 mm, made by the stage and known to the bench, by every calibration."""
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
        low, high = _expected_error(setup, np.array(true)).mean(axis=1)
        step = float(np.nanmean(upper) - np.nanmean(lower))
        yield setup.claim(
            "step_2500um", "plane", 1e3 * step, "um", _count(lower) + _count(upper),
            f"error of a true step of {true[1] - true[0]:.4f} mm; predicted from the stage as built",
            limit=4.0, predicted=1e3 * float(high - low),
        )  # fmt: skip


def _expected_error(setup: Setup, heights: np.ndarray) -> np.ndarray:
    """Systematic error of z at true ``heights`` (h,), (h, places) mm: none where the stage is not believed."""
    error = systematic_error(setup.bench, setup.readings, heights)
    return error if setup.believes_stage else np.zeros_like(error)


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


def _block_means(xy: np.ndarray, error: np.ndarray) -> np.ndarray:
    """Means of x, y and error over square blocks of which at least half is measured, (blocks, 3)."""
    rows, cols = (n - n % BLOCK_PX for n in error.shape)
    values = np.concatenate([xy, error[..., None]], axis=-1)[:rows, :cols]
    blocks = values.reshape(rows // BLOCK_PX, BLOCK_PX, cols // BLOCK_PX, BLOCK_PX, 3)
    blocks = blocks.swapaxes(1, 2).reshape(-1, BLOCK_PX * BLOCK_PX, 3)
    enough = np.isfinite(blocks[..., 2]).sum(axis=1) >= BLOCK_PX * BLOCK_PX / 2
    return np.nanmean(blocks[enough], axis=1)


def _without_rigid(xy: np.ndarray, error: np.ndarray) -> tuple[float, np.ndarray]:
    """Mean of vertical errors (n,) at places (n, 2), and what the best height and tilt leave of them."""
    design = np.column_stack([np.ones(len(xy)), xy])
    return float(error.mean()), error - design @ np.linalg.lstsq(design, error, rcond=None)[0]


def _count(values: np.ndarray) -> int:
    return int(np.isfinite(values).sum())


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.nanmean(np.square(values))))
