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
from .planes import BLOCK_PX, blocks_of, half_measured, mean, moved_by_motion, percentile, rms, vertical_error
from .setup import Setup

VOLUME_HEIGHTS_MM = (-1.48, -1.0, -0.5, 0.0, 0.5, 1.0, 1.48)
"""Stage positions between the calibration's heights, which are odd multiples of 0.05 mm; the ends reach past them."""

TILTS_DEG = ((20.0, 0.0), (0.0, -16.0), (-12.0, 10.0))
"""Rotations about x and y of tilted planes, at stage position 0: over the board's 8 mm and the 6.1 mm that are lit they
stay within 1.4 mm of height."""

PLANES = len(VOLUME_HEIGHTS_MM) + len(TILTS_DEG)

SYSTEMATIC_LIMITS_UM = (0.5, 1.5)  # root mean square, and for 99 %
LOST_LIMIT = 0.01
"""Of a plane's points may at most be lost to the end of the calibrated heights.

What is lost there is what erred outwards. If it is the largest errors, the 95 % point of the others is still that of
94 % of all."""
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
    exposures : int
        Of its run, before it.
    """

    tilted: bool
    stage_position: float
    world_from_plane: np.ndarray
    errors: np.ndarray
    blocks: np.ndarray
    span: np.ndarray
    noise: float
    filtered_noise: float
    exposures: int

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


def measure_volume(
    setups: Sequence[Setup], advance: Callable[[float], None], heights: Sequence[float] = VOLUME_HEIGHTS_MM
) -> list[list[MeasuredPlane]]:
    """Capture planes all over the volume, and evaluate each by every calibration: a list for each.

    Points exist where the measured height is one that the calibration knows. A plane of which that takes more than
    ``LOST_LIMIT`` is left out of the list: its points with the larger errors are not there to be judged.

    Parameters
    ----------
    setups : sequence of Setup
        They share one rig.
    advance : callable
        Called with 1 after each plane.
    heights : sequence of float
        Stage positions of the flat planes, mm.
    """
    found: list[list[MeasuredPlane]] = [[] for _ in setups]
    tilted = (Placement("plane", pose_mm_deg=(0.0, 0.0, 0.0, *tilt, 0.0)) for tilt in TILTS_DEG)
    for placement, positions in ((Placement("plane"), heights), *((held, (0.0,)) for held in tilted)):
        setups[0].place(placement)
        for position in positions:
            setups[0].rig.stage.move_to_mm(position)
            frames = setups[0].frames()
            phase_map = setups[0].decoded(frames)
            smoother = filter_phasors(phase_map, setups[0].filter_fwhm_px)
            for setup, planes in zip(setups, found, strict=True):
                if share_lost(setup, smoother) <= LOST_LIMIT:
                    planes.append(_measured(setup, placement, phase_map, smoother, int(frames.serials[0])))
            advance(1)
    return found


def share_lost(setup: Setup, phase_map: PhaseMap) -> float:
    """Share of the points of the mounted plane that its measured heights put beyond what the calibration knows.

    All are the pixels with a phase where the plane truly lies within their calibrated heights, with the margin that
    `reconstruct` leaves; 1 if there are none.
    """
    relation, margin = setup.calibration.phase_height, setup.calibration.procedure.plane_step_mm / 2
    phase = np.where(phase_map.valid, phase_map.absolute, np.nan)
    anywhere = PointMap(setup.calibration.rays.points(relation.height(phase)))
    true = anywhere.xyz[..., 2] - vertical_error(setup, anywhere)
    low, high = np.moveaxis(relation.z_range, -1, 0)
    known = (true > low - margin) & (true < high + margin)
    return 1 - float(np.mean(setup.points(phase_map).valid[known])) if known.any() else 1.0


def _measured(
    setup: Setup, placement: Placement, phase_map: PhaseMap, smoother: PhaseMap, exposures: int
) -> MeasuredPlane:
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
        exposures=exposures,
    )


def volume_claims(setup: Setup, planes: Sequence[MeasuredPlane]) -> Iterator[Claim]:
    """Depth error over the volume, and how large that volume is."""
    yield from depth_claims(setup, planes)
    yield from _extent_claims(setup, [plane for plane in planes if not plane.tilted])


def depth_claims(setup: Setup, planes: Sequence[MeasuredPlane]) -> Iterator[Claim]:
    """Depth error over the volume, predicted from stage, board and table as they are.

    Where a plane was left out, rows about all of them have no figure, and do not hold.
    """
    flat = [plane for plane in planes if not plane.tilted]
    tilted = [plane for plane in planes if plane.tilted]
    read = ", ".join(f"{plane.stage_position:+.2f}" for plane in flat) or "none"
    where = f"at {len(VOLUME_HEIGHTS_MM)} heights between the calibration's, measured where the stage read {read} mm"
    yield _percentile_claim(setup, flat, "depth_p95_volume", where, len(VOLUME_HEIGHTS_MM), paper=4.0)
    where = f"of {len(TILTS_DEG)} tilted planes, {len(tilted)} measured"
    yield _percentile_claim(setup, tilted, "depth_tilted_p95", where, len(TILTS_DEG), paper=None)
    yield from _systematic_claims(setup, planes)
    for plane in flat:
        yield setup.claim(
            f"depth_bias_at_{plane.stage_position:+.1f}mm", "plane", 1e3 * float(np.mean(plane.errors)), "um",
            len(plane.errors), "mean vertical error where the stage reads so", filter=setup.filter_name,
            **_prediction(np.mean, _foretold(setup, [plane])),
        )  # fmt: skip


def _percentile_claim(
    setup: Setup, planes: Sequence[MeasuredPlane], name: str, where: str, all_planes: int, paper: float | None
) -> Claim:
    criterion, limit = f"95 % of the vertical errors {where}", 4.0
    if len(planes) < all_planes:
        return setup.claim(
            name, "plane", np.nan, "um", 0, criterion, paper=paper, limit=limit, filter=setup.filter_name
        )
    heights = np.concatenate([plane.places[:, 2] for plane in planes])
    fixed = calibration_noise_share(setup, heights) * rms(np.array([plane.noise for plane in planes]))
    sigma = float(np.hypot(rms(np.array([plane.filtered_noise for plane in planes])), fixed))
    together = np.abs(np.concatenate([plane.errors for plane in planes]))
    return setup.claim(
        name, "plane", 1e3 * percentile(together, 95), "um", len(together), criterion, paper=paper, limit=limit,
        filter=setup.filter_name,
        **_prediction(lambda error: percentile_with_noise(error, sigma, 0.95), _foretold(setup, planes)),
    )  # fmt: skip


def _systematic_claims(setup: Setup, planes: Sequence[MeasuredPlane]) -> Iterator[Claim]:
    """What is left when noise is averaged out, beside the best rigid motion of the whole volume."""
    averaged, motion = f"mean over blocks of {BLOCK_PX} x {BLOCK_PX} px", "one rigid motion of all planes"
    if len(planes) < PLANES:
        of = f"of all {PLANES} planes, {len(planes)} measured"
        yield setup.claim("depth_origin", "plane", np.nan, "um", 0, f"mean vertical error {of}", filter=averaged)
        for name in ("depth_systematic", "depth_tilted_systematic"):
            for suffix, limit in zip(("rms", "p99"), SYSTEMATIC_LIMITS_UM, strict=True):
                yield setup.claim(
                    f"{name}_{suffix}", "plane", np.nan, "um", 0, f"vertical error {of}", limit=limit,
                    filter=averaged, alignment=motion,
                )  # fmt: skip
        return
    error = np.concatenate([plane.blocks[:, 3] for plane in planes])
    foretold = _foretold(setup, planes)
    yield setup.claim(
        "depth_origin", "plane", 1e3 * mean(error), "um", len(error), "mean vertical error over all planes",
        filter=averaged, **_prediction(np.mean, foretold),
    )  # fmt: skip
    left = without_motion([plane.blocks[:, :3] for plane in planes], planes, error)
    foretold = without_motion([plane.places for plane in planes], planes, foretold.T).T
    share = calibration_noise_share(setup, np.array([plane.stage_position for plane in planes]))
    # What the mean over a block leaves of its pixels' noise: measured figures contain it.
    noise = float(np.hypot(1, share)) * rms(np.array([plane.noise for plane in planes])) / BLOCK_PX
    of_tilted, tilted_places = (
        np.concatenate([np.full(len(points), plane.tilted) for plane, points in zip(planes, sets, strict=True)])
        for sets in ([plane.blocks for plane in planes], [plane.places for plane in planes])
    )
    for name, measured, draws, which in (
        ("depth_systematic", left, foretold, "all planes"),
        ("depth_tilted_systematic", left[of_tilted], foretold[:, tilted_places], "the tilted planes"),
    ):
        for measured_um, statistic, suffix, limit, criterion in (
            (1e3 * rms(measured), lambda e: float(np.hypot(rms(e), noise)), "rms", SYSTEMATIC_LIMITS_UM[0],
             "root mean square vertical error"),
            (1e3 * percentile(np.abs(measured), 99), lambda e: percentile_with_noise(e, noise, 0.99), "p99",
             SYSTEMATIC_LIMITS_UM[1], "99 % of the vertical errors"),
        ):  # fmt: skip
            # The bundle's errors are those of its fit, which no model of stage and board foretells.
            prediction = _prediction(statistic, draws) if setup.believes_stage else Prediction()
            yield setup.claim(
                f"{name}_{suffix}", "plane", measured_um, "um", len(measured), f"{criterion} of {which}",
                limit=limit, filter=averaged, alignment=motion, **prediction,
            )  # fmt: skip


def _extent_claims(setup: Setup, flat: Sequence[MeasuredPlane]) -> Iterator[Claim]:
    board = setup.calibration.board.size_mm
    low = high = np.full(2, np.nan)
    depth = np.nan
    if flat:
        low, high = np.max([plane.span[0] for plane in flat], axis=0), np.min([plane.span[1] for plane in flat], axis=0)
        depth = float(np.ptp([plane.world_from_plane[2, 3] for plane in flat]))
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
        draws.append((error + left_to_chance(setup, heights[None], plane.exposures))[:, 0])
    return np.concatenate(draws, axis=1)


def _prediction(statistic: Callable[[np.ndarray], float], draws: np.ndarray) -> Prediction:
    """Mean and standard deviation in µm of a figure over draws (draws, places) of errors in mm."""
    figures = [1e3 * statistic(errors) if errors.size else np.nan for errors in draws]
    return {"predicted": float(np.mean(figures)), "predicted_sd": float(np.std(figures))}


def without_motion(points: Sequence[np.ndarray], planes: Sequence[MeasuredPlane], error: np.ndarray) -> np.ndarray:
    """What the best small rigid motion of all points together leaves of their vertical errors.

    Parameters
    ----------
    points : sequence of (n_i, 3)
        Of each plane, mm.
    planes : sequence of MeasuredPlane
    error : (n,) or (n, draws)
        Vertical errors of all points, one plane after the other.
    """
    moved = [moved_by_motion(xyz, np.asarray(plane.slope))[:, 2] for xyz, plane in zip(points, planes, strict=True)]
    design = np.concatenate(moved)
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
