"""Claims about the volume: depth errors of flat and tilted planes all over it, and how large it is."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from greenough.instrument.contract import Placement
from greenough.pipeline.decode import PhaseMap
from greenough.pipeline.phasor_filter import filter_phasors
from greenough.pipeline.reconstruct import PointMap

from .claims import Claim, Prediction
from .mechanics import calibration_noise_share, expected_error, left_to_chance, percentile_with_noise
from .planes import BLOCK_PX, blocks_of, half_measured, rms, vertical_error
from .setup import Setup

VOLUME_HEIGHTS_MM = (-1.48, -1.0, -0.5, 0.0, 0.5, 1.0, 1.48)
"""Stage positions between the calibration's heights, which are odd multiples of 0.05 mm; the ends reach past them."""

TILTS_DEG = ((20.0, 0.0), (0.0, -16.0), (-12.0, 10.0))
"""Rotations about x and y of tilted planes, at stage position 0: over the board's 8 mm and the 6.1 mm that are lit they
stay within 1.4 mm of height."""

PLANES = len(VOLUME_HEIGHTS_MM) + len(TILTS_DEG)

SYSTEMATIC_LIMITS_UM = (0.5, 1.5)  # root mean square, and for 99 %
_EVERY = 13  # blocks between those for which systematic errors are predicted


@dataclass(frozen=True, eq=False)
class MeasuredPlane:
    """A plane somewhere in the volume; lengths in mm.

    Parameters
    ----------
    tilted : bool
    stage_position : float
        What the stage read.
    world_from_plane : (4, 4)
        How it really lay.
    errors : (points,)
        Vertical, of filtered points.
    blocks : (blocks, 6)
        x, y, z and vertical error of unfiltered points, and the lowest and highest height that their pixels are
        calibrated for: means over blocks of pixels.
    span : (2, 2)
        Lowest and highest x and y that are measured along the middle of the field; NaN where nothing is.
    noise, filtered_noise : float
        Predicted of one exposure.
    """

    tilted: bool
    stage_position: float
    world_from_plane: np.ndarray
    errors: np.ndarray
    blocks: np.ndarray
    span: np.ndarray
    noise: float
    filtered_noise: float

    @property
    def slope(self) -> np.ndarray:
        """dz/dx and dz/dy, (2,)."""
        normal = self.world_from_plane[:3, 2]
        return -normal[:2] / normal[2]

    @property
    def z_range(self) -> np.ndarray:
        """Calibrated heights (n, 2) at ``places``, mm."""
        return self.blocks[_EVERY // 2 :: _EVERY, 4:]

    @property
    def places(self) -> np.ndarray:
        """Some points (n, 3) of the true plane that stand for it, mm."""
        some = self.blocks[_EVERY // 2 :: _EVERY]
        return np.column_stack([some[:, :2], some[:, 2] - some[:, 3]])


def measure_volume(setups: Sequence[Setup], advance: Callable[[float], None]) -> list[list[MeasuredPlane]]:
    """Capture planes all over the volume, and evaluate each by every calibration: a list for each.

    A plane that lies wholly beyond the heights that a calibration knows is left out of its list.
    """
    found: list[list[MeasuredPlane]] = [[] for _ in setups]
    tilted = (Placement("plane", pose_mm_deg=(0.0, 0.0, 0.0, *tilt, 0.0)) for tilt in TILTS_DEG)
    for placement, heights in ((Placement("plane"), VOLUME_HEIGHTS_MM), *((held, (0.0,)) for held in tilted)):
        setups[0].place(placement)
        for height in heights:
            setups[0].rig.stage.move_to_mm(height)
            phase_map = setups[0].capture()
            smoother = filter_phasors(phase_map, setups[0].filter_fwhm_px)
            for setup, planes in zip(setups, found, strict=True):
                if setup.points(smoother).valid.any():
                    planes.append(_measured(setup, placement, phase_map, smoother))
            advance(1)
    return found


def _measured(setup: Setup, placement: Placement, phase_map: PhaseMap, smoother: PhaseMap) -> MeasuredPlane:
    points, unfiltered = setup.points(smoother), setup.points(phase_map)
    return MeasuredPlane(
        tilted=any(placement.pose_mm_deg),
        stage_position=setup.rig.stage.position_mm,
        world_from_plane=setup.bench.world_from_part,
        errors=vertical_error(setup, points)[points.valid],
        blocks=_block_means(unfiltered, vertical_error(setup, unfiltered), setup.calibration.phase_height.z_range),
        span=_span(points),
        noise=rms(setup.height_sigma(phase_map)[points.valid]),
        filtered_noise=rms(setup.height_sigma(smoother)[points.valid]),
    )


def volume_claims(setup: Setup, planes: Sequence[MeasuredPlane]) -> Iterator[Claim]:
    """Depth error over the volume, and how large that volume is."""
    yield from depth_claims(setup, planes)
    yield from _extent_claims(setup, [plane for plane in planes if not plane.tilted])


def depth_claims(setup: Setup, planes: Sequence[MeasuredPlane]) -> Iterator[Claim]:
    """Depth error over the volume, predicted from stage, board and table as they are."""
    flat = [plane for plane in planes if not plane.tilted]
    tilted = [plane for plane in planes if plane.tilted]
    yield _percentile_claim(
        setup, flat, "depth_p95_volume", f"at {len(flat)} heights between the calibration's", paper=4.0
    )
    yield _percentile_claim(setup, tilted, "depth_tilted_p95", f"of {len(tilted)} tilted planes", paper=None)
    yield from _systematic_claims(setup, planes)
    for plane in flat:
        yield setup.claim(
            f"depth_bias_at_{plane.stage_position:+.1f}mm", "plane", 1e3 * float(np.mean(plane.errors)), "um",
            len(plane.errors), "mean vertical error where the stage reads so", filter=setup.filter_name,
            **_prediction(np.mean, _foretold(setup, [plane])),
        )  # fmt: skip


def _percentile_claim(
    setup: Setup, planes: Sequence[MeasuredPlane], name: str, where: str, paper: float | None
) -> Claim:
    heights = np.concatenate([plane.places[:, 2] for plane in planes])
    fixed = calibration_noise_share(setup, heights) * rms(np.array([plane.noise for plane in planes]))
    sigma = float(np.hypot(rms(np.array([plane.filtered_noise for plane in planes])), fixed))
    together = np.abs(np.concatenate([plane.errors for plane in planes]))
    return setup.claim(
        name, "plane", 1e3 * float(np.percentile(together, 95)), "um", len(together),
        f"95 % of the vertical errors {where}", paper=paper, limit=4.0, filter=setup.filter_name,
        **_prediction(lambda error: percentile_with_noise(error, sigma, 0.95), _foretold(setup, planes)),
    )  # fmt: skip


def _systematic_claims(setup: Setup, planes: Sequence[MeasuredPlane]) -> Iterator[Claim]:
    """What is left when noise is averaged out, beside the best rigid motion of the whole volume."""
    averaged = f"mean over blocks of {BLOCK_PX} x {BLOCK_PX} px"
    error = np.concatenate([plane.blocks[:, 3] for plane in planes])
    foretold = _foretold(setup, planes)
    yield setup.claim(
        "depth_origin", "plane", 1e3 * float(np.mean(error)), "um", len(error), "mean vertical error over all planes",
        filter=averaged, **_prediction(np.mean, foretold),
    )  # fmt: skip
    left = without_motion([plane.blocks[:, :3] for plane in planes], planes, error)
    foretold = without_motion([plane.places for plane in planes], planes, foretold.T).T
    of_tilted, tilted_places = (
        np.concatenate([np.full(len(points), plane.tilted) for plane, points in zip(planes, sets, strict=True)])
        for sets in ([plane.blocks for plane in planes], [plane.places for plane in planes])
    )
    for name, measured, draws, which in (
        ("depth_systematic", left, foretold, "all planes"),
        ("depth_tilted_systematic", left[of_tilted], foretold[:, tilted_places], "the tilted planes"),
    ):
        for statistic, suffix, limit, criterion in (
            (rms, "rms", SYSTEMATIC_LIMITS_UM[0], "root mean square vertical error"),
            (_p99, "p99", SYSTEMATIC_LIMITS_UM[1], "99 % of the vertical errors"),
        ):
            # The bundle's errors are those of its fit, which no model of stage and board foretells.
            prediction = _prediction(statistic, draws) if setup.believes_stage else Prediction()
            yield setup.claim(
                f"{name}_{suffix}", "plane", 1e3 * statistic(measured), "um", len(measured), f"{criterion} of {which}",
                limit=limit, filter=averaged, alignment="one rigid motion of all planes", **prediction,
            )  # fmt: skip


def _extent_claims(setup: Setup, flat: Sequence[MeasuredPlane]) -> Iterator[Claim]:
    low, high = np.max([plane.span[0] for plane in flat], axis=0), np.min([plane.span[1] for plane in flat], axis=0)
    heights = [plane.world_from_plane[2, 3] for plane in flat]
    board, depth = setup.calibration.board.size_mm, heights[-1] - heights[0]
    lean = np.tan(np.radians(setup.bench.settings.optics.convergence_deg / 2))
    # The blank side as seen by a camera that leans shifts over the depth: that much less is covered at all heights.
    across = board - lean * depth
    width, length = high - low
    yield setup.claim(
        "volume_x", "plane", width, "mm", len(flat),
        f"width measured at all heights is at least 0.96 of {across:.2f} mm, the board less its parallax", paper=8.0,
        limit=0.96 * across, at_least=True, predicted=across,
    )  # fmt: skip
    yield setup.claim(
        "volume_y", "plane", length, "mm", len(flat), "length measured at all heights is at least 5.9 mm",
        paper=6.0, limit=5.9, at_least=True,
    )  # fmt: skip
    yield setup.claim(
        "z_range", "plane", depth, "mm", len(flat), "true distance of the outermost planes is at least 2.9 mm",
        paper=3.0, limit=2.9, at_least=True,
    )  # fmt: skip


def _foretold(setup: Setup, planes: Sequence[MeasuredPlane]) -> np.ndarray:
    """Draws of the systematic vertical errors at all planes' places, (draws, places) mm."""
    draws = []
    for plane in planes:
        *xy, heights = plane.places.T
        error = expected_error(setup, heights[None], np.column_stack(xy), plane.z_range)
        draws.append((error + left_to_chance(setup, heights[None]))[:, 0])
    return np.concatenate(draws, axis=1)


def _prediction(statistic: Callable[[np.ndarray], float], draws: np.ndarray) -> Prediction:
    """Mean and standard deviation in µm of a figure over draws (draws, places) of errors in mm."""
    figures = [1e3 * statistic(errors) for errors in draws]
    return {"predicted": float(np.mean(figures)), "predicted_sd": float(np.std(figures))}


def without_motion(points: Sequence[np.ndarray], planes: Sequence[MeasuredPlane], error: np.ndarray) -> np.ndarray:
    """What the best small rigid motion of all points together leaves of their vertical errors.

    A point that moves by d on a surface of slope s comes to lie d_z - s · d_xy above it, where d = t + ω x p.

    Parameters
    ----------
    points : sequence of (n_i, 3)
        Of each plane, mm.
    planes : sequence of MeasuredPlane
    error : (n,) or (n, draws)
        Vertical errors of all points, one plane after the other.
    """
    columns = []
    for xyz, plane in zip(points, planes, strict=True):
        x, y, z = xyz.T
        along, down = plane.slope
        one = np.ones(len(xyz))
        columns.append([-along * one, -down * one, one, y + down * z, -x - along * z, along * y - down * x])
    design = np.concatenate([np.transpose(column) for column in columns])
    return error - design @ np.linalg.lstsq(design, error, rcond=None)[0]


def _block_means(points: PointMap, error: np.ndarray, z_range: np.ndarray) -> np.ndarray:
    """``MeasuredPlane.blocks`` of images, ``z_range`` (rows, cols, 2): blocks of which at least half is measured."""
    z_range = np.where(points.valid[..., None], z_range, np.nan)
    images = (*np.moveaxis(points.xyz, -1, 0), error, *np.moveaxis(z_range, -1, 0))
    blocks = np.stack([blocks_of(image) for image in images], axis=-1)
    return np.nanmean(blocks[half_measured(blocks[..., 3])], axis=1)


def _span(points: PointMap) -> np.ndarray:
    """Lowest and highest x and y that are measured along the middle of the field, (2, 2) mm; NaN if nothing is."""
    xyz = points.xyz[points.valid]
    along_x, along_y = xyz[np.abs(xyz[:, 1]) < 0.5, 0], xyz[np.abs(xyz[:, 0]) < 0.5, 1]
    if not (len(along_x) and len(along_y)):
        return np.full((2, 2), np.nan)
    return np.array([[along_x.min(), along_y.min()], [along_x.max(), along_y.max()]])


def _p99(error: np.ndarray) -> float:
    return float(np.percentile(np.abs(error), 99))
