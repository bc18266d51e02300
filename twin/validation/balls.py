"""Claims about a ball grid array: its balls' apexes, their coplanarity, the balls' caps, and the substrate.

What a pixel sees is decided by its true point alone: a ball, at a polar angle that is the slope of its surface there,
or the substrate. Heights are judged as everywhere, by z less that of the surface on the same (x, y), here of the
spheres and the plane from which the mesh was made.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.spatial import KDTree

from greenough.pipeline.metrology.coplanarity import coplanarity, regression_plane, seating_planes

from ..bench import Bench
from .claims import Claim
from .measured import (
    BIAS_LIMIT_UM,
    DECONVOLVED,
    DECONVOLVED_FILTERED,
    FILTERED,
    P95_LIMIT_UM,
    RAW,
    VALID_SHARE_LIMIT,
    Measured,
    filter_name,
    has_limits,
    noise_quantile,
    with_noise,
)
from .setup import Setup

CAPS_DEG = (15, 45)
"""Slopes up to which the balls' caps are judged: the rows of the first must keep to limits, the others report."""

CAP_VALID_SHARE_LIMIT = 0.9
APEX_LIMIT_UM, COPLANARITY_LIMIT_UM = 2.0, 4.0
TOLERANCE_UM = 50.0  # of the ball height on the drawing

OUTLIER_MM = 0.05
"""A cap of 15 degrees is 9 um high: what lies farther than this from its median was not seen in direct light."""

APEX_DEG = 15
APEX_FILTER = f"paraboloid over {APEX_DEG} degrees, without points beyond {OUTLIER_MM:g} mm of their median"

_MIN_POINTS = 6  # of a paraboloid with 4 parameters
_ON_SURFACE_MM = 1e-3  # facets depart by less from the spheres, and balls stand higher above the substrate


@dataclass(frozen=True, eq=False)
class BallGridAsMounted:
    """The spheres and the plane under the microscope, in the part's own frame.

    Parameters
    ----------
    part_from_world : (4, 4)
    apexes : (balls, 3)
    radii : (balls,)
    substrate : float
        z of the substrate, mm.
    """

    part_from_world: np.ndarray
    apexes: np.ndarray
    radii: np.ndarray
    substrate: float

    @classmethod
    def of(cls, bench: Bench) -> "BallGridAsMounted":
        """Of the array that is mounted."""
        built = bench.specimen.as_built
        return cls(
            np.linalg.inv(bench.world_from_part),
            built["ball_apexes_mm"],
            built["ball_radii_mm"],
            float(bench.specimen.nominal["substrate_z_mm"]),
        )

    def in_part(self, xyz_world: np.ndarray) -> np.ndarray:
        """Points (..., 3) in the part's frame."""
        return xyz_world @ self.part_from_world[:3, :3].T + self.part_from_world[:3, 3]

    def nearest_ball(self, points: np.ndarray) -> np.ndarray:
        """Index (...,) of the ball whose axis is nearest to points (..., 3) of the part's frame."""
        return np.asarray(KDTree(self.apexes[:, :2]).query(np.nan_to_num(points[..., :2]))[1])

    def slope_deg(self, points: np.ndarray) -> np.ndarray:
        """Slope (...,) of the ball that points (..., 3) of the part's frame lie on; NaN where they lie on none."""
        ball = self.nearest_ball(points)
        offset = points - self.apexes[ball]
        offset[..., 2] += self.radii[ball]
        distance = np.linalg.norm(offset, axis=-1)
        on_ball = (np.abs(distance - self.radii[ball]) < _ON_SURFACE_MM) & ~self.on_substrate(points)
        return np.where(on_ball, np.degrees(np.arccos(np.clip(offset[..., 2] / distance, -1, 1))), np.nan)

    def on_substrate(self, points: np.ndarray) -> np.ndarray:
        """Whether points (..., 3) of the part's frame lie on the substrate, (...,) bool."""
        return np.abs(points[..., 2] - self.substrate) < _ON_SURFACE_MM

    def errors_above_balls(self, points: np.ndarray) -> np.ndarray:
        """Heights of points (..., 3) of the part's frame above the nearest ball on the same (x, y).

        Beside it a point has no height above it: its error is infinite, whatever its z. NaN without a point.
        """
        ball = self.nearest_ball(points)
        aside = np.sum((points[..., :2] - self.apexes[ball][..., :2]) ** 2, axis=-1)
        below_apex = self.radii[ball] - np.sqrt(np.maximum(self.radii[ball] ** 2 - aside, 0))
        height = points[..., 2] - self.apexes[ball][..., 2] + below_apex
        return np.where(aside >= self.radii[ball] ** 2, np.inf, height)

    def apex_heights(self, points: np.ndarray) -> np.ndarray:
        """Tops (balls,) of the paraboloids through measured points (n, 3) around each true apex; NaN with too few."""
        ball = self.nearest_ball(points)
        offset = points[:, :2] - self.apexes[ball, :2]
        near = np.hypot(*offset.T) < self.radii[ball] * np.sin(np.radians(APEX_DEG))
        heights = np.full(len(self.apexes), np.nan)
        for k in range(len(heights)):
            of = near & (ball == k)
            if of.any():
                heights[k] = _top(offset[of, 0], offset[of, 1], points[of, 2])
        return heights


def _top(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> float:
    """Top of a paraboloid of free height, place and curvature; NaN with too few points, or if it has none."""
    kept = np.abs(z - np.median(z)) < OUTLIER_MM
    if kept.sum() < _MIN_POINTS:
        return np.nan
    x, y, z = x[kept], y[kept], z[kept]
    design = np.column_stack([np.ones_like(x), x, y, x * x + y * y])
    c, a, b, k = np.linalg.lstsq(design, z, rcond=None)[0]
    return float(c - (a * a + b * b) / (4 * k)) if k < 0 else np.nan


def ball_claims(setup: Setup, measured: Measured) -> Iterator[Claim]:
    """All rows of one treatment that only a ball grid array has."""
    grid = BallGridAsMounted.of(setup.bench)
    lit_and_seen = measured.truth.lit_and_seen
    points = grid.in_part(measured.points.xyz[lit_and_seen])  # (pixels, 3), as all below
    heights = grid.apex_heights(points[np.isfinite(points[:, 2])])
    yield from _apex_claims(setup, measured, heights - grid.apexes[:, 2], grid.radii)
    yield from _coplanarity_claims(setup, measured, grid.apexes, heights)
    truth = grid.in_part(measured.truth.xyz_world[lit_and_seen])
    slope, errors = grid.slope_deg(truth), grid.errors_above_balls(points)
    for steepest in CAPS_DEG:
        limited = steepest == CAPS_DEG[0] and has_limits(setup, measured)
        what = f"where the true surface is that of a ball and slopes by up to {steepest} degrees"
        yield from _surface_claims(
            setup, measured, f"cap{steepest}", slope <= steepest, errors, what,
            p95_limit=P95_LIMIT_UM if limited else None,
            share_limit=CAP_VALID_SHARE_LIMIT if limited else None,
        )  # fmt: skip
    limited = has_limits(setup, measured)
    yield from _surface_claims(
        setup, measured, "substrate", grid.on_substrate(truth), points[..., 2] - grid.substrate,
        "where the true surface is the substrate",
        p95_limit=P95_LIMIT_UM if limited else None,
        bias_limit=BIAS_LIMIT_UM if limited else None,
        share_limit=VALID_SHARE_LIMIT if limited else None,
    )  # fmt: skip


def _apex_claims(setup: Setup, measured: Measured, errors: np.ndarray, radii: np.ndarray) -> Iterator[Claim]:
    """Heights of the balls' apexes against truth, ``errors`` (balls,) mm: predicted is what the filter does to them.

    With fewer than two apexes the rows are there and NaN.
    """
    errors = 1e3 * errors[np.isfinite(errors)]
    bias = sd = largest = np.nan
    if len(errors) > 1:
        bias, sd, largest = np.mean(errors), np.std(errors, ddof=1), np.abs(errors).max()
    suffix, filter = measured.suffix, _apex_filter(setup, measured)
    limit = APEX_LIMIT_UM if _apexes_have_limits(setup, measured) else None
    # A Gaussian of variance s² lowers a surface of mean curvature 1 / R by s² / R.
    flattened = (
        -1e3 * _filter_variance(setup) / radii if measured.treatment in (FILTERED, DECONVOLVED_FILTERED) else None
    )
    for name, value, predicted, criterion in (
        ("ball_apex_bias", bias, np.mean, "mean error of the apex heights"),
        ("ball_apex_sd", sd, np.std, "standard deviation of the apex heights' errors"),
    ):
        yield setup.claim(
            name + suffix, measured.name, float(value), "um", len(errors), criterion, limit=limit, filter=filter,
            predicted=None if flattened is None else float(predicted(flattened)),
        )  # fmt: skip
    yield setup.claim(
        f"ball_apex_within_tolerance{suffix}", measured.name, float(largest), "um", len(errors),
        "largest error of an apex height, beside the drawing's tolerance of the part", paper=TOLERANCE_UM,
        limit=None if limit is None else TOLERANCE_UM, filter=filter,
    )  # fmt: skip


def _coplanarity_claims(setup: Setup, measured: Measured, apexes: np.ndarray, heights: np.ndarray) -> Iterator[Claim]:
    """Coplanarity of the measured ``heights`` (balls,) less that of the true ``apexes`` (balls, 3).

    NaN where an apex was not found: it may be the worst.
    """
    found = np.isfinite(heights)
    seen = np.column_stack([apexes[:, :2], heights])
    centre = np.zeros(2)  # of the package: its frame's origin
    for name, plane, planes_of in (
        ("coplanarity_error", "seating plane, on which the package stands", partial(seating_planes, centre=centre)),
        ("coplanarity_regression_error", "regression plane, moved to the highest apex", regression_plane),
    ):
        error = np.nan
        if found.all():
            error = coplanarity(seen, planes_of(seen)) - coplanarity(apexes, planes_of(apexes))
        yield setup.claim(
            name + measured.suffix, measured.name, 1e3 * error, "um", int(found.sum()),
            f"largest distance of an apex from the {plane}, less that of the true apexes from theirs",
            limit=COPLANARITY_LIMIT_UM if _apexes_have_limits(setup, measured) else None,
            filter=_apex_filter(setup, measured),
        )  # fmt: skip


def _surface_claims(
    setup: Setup,
    measured: Measured,
    name: str,
    region: np.ndarray,
    errors: np.ndarray,
    what: str,
    *,
    p95_limit: float | None,
    share_limit: float | None,
    bias_limit: float | None = None,
) -> Iterator[Claim]:
    """Bias, spread and coverage of a region (pixels,) of what is lit and seen, by the errors (pixels,) there in mm.

    The rows are there wherever truth has such pixels, and NaN if none of them was measured. Infinite errors count in
    the spread; a mean they would not leave, so that it is of the others.
    """
    suffix, filter = measured.suffix, filter_name(setup, measured.treatment)
    valid, smooth, sigma = (
        image[measured.truth.lit_and_seen] for image in (measured.points.valid, measured.smooth, measured.height_sigma)
    )
    judged = region & smooth & ~np.isnan(errors)
    error = 1e3 * errors[judged]
    finite = error[np.isfinite(error)]
    if np.any(region & smooth):
        beside = len(error) - len(finite)
        without = f", without {beside} points beside their surface" if beside else ""
        yield setup.claim(
            f"{name}_bias{suffix}", measured.name, float(finite.mean()) if len(finite) else np.nan, "um", len(finite),
            f"mean vertical error {what} and smooth{without}", limit=bias_limit, filter=filter,
        )  # fmt: skip
        # Nothing is interpolated: between a finite and an infinite error there is nothing.
        p95 = float(np.quantile(np.abs(error), 0.95, method="higher")) if len(error) else np.nan
        yield setup.claim(
            f"{name}_p95{suffix}", measured.name, p95, "um", len(error),
            with_noise(f"95 % of the vertical errors {what} and smooth", 1e3 * noise_quantile(sigma[judged])),
            limit=p95_limit, filter=filter,
        )  # fmt: skip
    if not region.any():
        return
    yield setup.claim(
        f"{name}_valid_share{suffix}", measured.name, float(valid[region].mean()), "1", int(region.sum()),
        f"points among the pixels that are lit and seen {what}", limit=share_limit, at_least=True, filter=filter,
    )  # fmt: skip


def _apexes_have_limits(setup: Setup, measured: Measured) -> bool:
    """Apexes are fitted over a cap and need no filter, which would flatten the caps."""
    return not setup.believes_stage and measured.treatment == DECONVOLVED


def _apex_filter(setup: Setup, measured: Measured) -> str:
    if measured.treatment == RAW:
        return APEX_FILTER
    return f"{filter_name(setup, measured.treatment)}, {APEX_FILTER}"


def _filter_variance(setup: Setup) -> float:
    """Variance of the one filter's Gaussian along an axis, on the specimen, mm²."""
    optics = setup.bench.settings.optics
    pixel = optics.pupil_distance_mm / optics.camera_focal_px
    return (setup.filter_fwhm_px * pixel) ** 2 / (8 * np.log(2))
