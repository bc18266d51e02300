"""Whether all postures show the same board, and whether together they determine a calibration.

What the spots of a posture leave over against the drawing is print, which goes with the board from posture to posture,
and noise, which does not. Turned into the board's frame, the residuals p_k of a posture therefore repeat those of all
others: of the regression of p_k on the mean of the others the coefficient is nearly 1, and 0 if the print is another.
A board with another pitch has another scale: the camera alone takes this for another distance, but the fringes on the
spots tell the distance, so that in a bundle of both it remains in the residuals as a radial pattern.
"""

from collections.abc import Sequence as Many
from dataclasses import dataclass

import numpy as np
from scipy.spatial import ConvexHull
from scipy.stats import norm
from scipy.stats import t as student

from greenough.instrument.contract import SpotBoard
from greenough.instrument.errors import InputError

from ..blas import on_one_thread
from ..calibration import Calibration
from ..camera_calibration import CameraCalibration, calibrate_camera
from .finding import FALSE_ALARM, Finding, Yardstick

MIN_SHARED = 12
"""Spots that a posture must share with others to be compared with them."""

LEAST_TILT_DEG = 5.0
LEAST_COVERAGE = 0.5
"""Of the calibrated pixels, within the hull of all spots."""

LEAST_SD_UM = 2.0
"""Standard uncertainty of heights by the calibration that a sound set of postures stays below: half of the ± 4 µm that
95 % of the paper's errors keep to."""

_STEP_MM = 1e-3  # of differences
_RELATIVE_OF_PRINT = 0.5  # of the print's variance that residuals must share before they tell boards apart


@dataclass(frozen=True, eq=False)
class Prints:
    """Residuals on the board.

    Parameters
    ----------
    residuals_um : (postures, spots, 2)
        Measured minus nominal place of each spot in the board's frame, after each posture's pose and the camera were
        fitted; NaN where unseen.
    """

    residuals_um: np.ndarray

    def compared(self, posture: int) -> tuple[float, float, float]:
        """Regression coefficient on the mean of the other postures, its standard error, and what is unlike, µm.

        NaN where too few spots are shared. Noise of the mean draws the coefficient below 1; the expected one is that of
        the other postures.
        """
        own = self.residuals_um[posture]
        others = np.delete(self.residuals_um, posture, axis=0)
        count = np.isfinite(others[..., 0]).sum(axis=0)
        shared = np.isfinite(own[:, 0]) & (count >= 2)
        if shared.sum() < MIN_SHARED:
            return np.nan, np.nan, np.nan
        mean = (np.nansum(others, axis=0) / np.maximum(count, 1)[:, None])[shared].ravel()
        own = own[shared].ravel()
        slope = own @ mean / (mean @ mean)
        left = own - slope * mean
        error = np.sqrt(left @ left / (len(own) - 4) / (mean @ mean))
        return float(slope), float(error), float(np.sqrt(np.mean((own - mean) ** 2)))


def prints_of(camera: CameraCalibration, board: SpotBoard) -> Prints:
    """Residuals of a camera's calibration, turned into the board's frame by its poses."""
    centres, radii = board.centres(), board.diameters() / 2
    moved = [
        camera.camera.project_circles(centres + step, radii, camera.camera_from_board)
        - camera.camera.project_circles(centres - step, radii, camera.camera_from_board)
        for step in _STEP_MM * np.eye(2)
    ]
    px_per_mm = np.stack(moved, axis=-1) / (2 * _STEP_MM)  # (postures, spots, 2, 2)
    return Prints(1e3 * np.linalg.solve(px_per_mm, camera.residuals_px[..., None])[..., 0])


def check_boards(camera: CameraCalibration, board: SpotBoard, names: Many[str], yardstick: Yardstick) -> list[Finding]:
    """A posture whose print is not that of the others."""
    compared = np.array([prints_of(camera, board).compared(k) for k in range(len(names))])
    slopes, errors, apart = compared.T
    known = np.flatnonzero(np.isfinite(slopes))
    if len(known) < 4:
        return []
    findings = []
    for k in map(int, known):
        others = known[known != k]
        # Weights of the others' coefficients: how exactly each is known.
        weight = errors[others] ** -2
        expected = float(np.sum(weight * slopes[others]) / np.sum(weight))
        if expected < _RELATIVE_OF_PRINT:
            continue  # noise hides the print: nothing can be told
        off = (expected - slopes[k]) / np.hypot(errors[k], np.sum(weight) ** -0.5)
        if off < norm.isf(FALSE_ALARM / len(known)) or apart[k] < yardstick.least_um:
            continue
        effect_um = float(apart[k])
        findings.append(
            Finding(
                name="another board",
                where=f"posture {names[k]}",
                effect_rad=yardstick.rad(effect_um),
                effect_um=effect_um,
                cause="the spots do not lie where those of the other postures do: another board, or the board was "
                "damaged or moved while frames were taken",
                remedy="calibrate again with one board in all postures, or without this posture",
                evidence={"likeness": float(slopes[k]), "others_likeness": expected, "standard_errors": float(off)},
            )
        )
    return findings


@on_one_thread
def check_scales(calibration: Calibration, names: Many[str], yardstick: Yardstick) -> list[Finding]:
    """A posture whose residuals in a bundle with fringes grow with the distance from its middle."""
    residuals, centres = calibration.residuals.spots_px, calibration.residuals.centres_px
    scales, errors = [], []
    for residual, centre in zip(residuals, centres, strict=True):
        used = np.isfinite(residual[:, 0])
        if used.sum() < MIN_SHARED:
            scales.append(np.nan)
            errors.append(np.nan)
            continue
        arm = (centre[used] - centre[used].mean(axis=0)).ravel()
        left = (residual[used] - residual[used].mean(axis=0)).ravel()
        scale = arm @ left / (arm @ arm)
        errors.append(np.sqrt(np.sum((left - scale * arm) ** 2) / (len(arm) - 3) / (arm @ arm)))
        scales.append(scale)
    findings = []
    size_mm = np.hypot(*(calibration.board.pitch_mm * np.array([calibration.board.rows, calibration.board.cols]))) / 4
    for k in map(int, np.flatnonzero(np.isfinite(scales))):
        others = np.delete(np.array(scales), k)
        others = others[np.isfinite(others)]
        if len(others) < 4:
            continue
        middle, spread = np.median(others), np.std(others, ddof=1)
        off = abs(scales[k] - middle) / np.hypot(errors[k], spread)
        effect_um = 1e3 * float(abs(scales[k] - middle)) * size_mm
        if off < student.isf(FALSE_ALARM / 2 / len(scales), len(others) - 1) or effect_um < yardstick.least_um:
            continue
        findings.append(
            Finding(
                name="another board",
                where=f"posture {names[k]}",
                effect_rad=yardstick.rad(effect_um),
                effect_um=effect_um,
                cause="the board of this posture is larger or smaller than that of the others",
                remedy="calibrate again with one board in all postures, or without this posture",
                evidence={"scale_departure_ppm": 1e6 * float(scales[k] - middle), "standard_errors": float(off)},
            )
        )
    return findings


def check_postures(calibration: Calibration, yardstick: Yardstick) -> list[Finding]:
    """Postures that are too few, too level or in too small a part of the field for what is calibrated from them."""
    try:
        camera = camera_of(calibration)
    except InputError:
        return []
    valid = calibration.phase_height.valid
    v, u = np.nonzero(valid)
    chosen = slice(None, None, max(1, len(u) // 2000))
    pixels = np.column_stack([u, v])[chosen].astype(float)
    low, high = calibration.figures["z_low_mm"], calibration.figures["z_high_mm"]
    ends = [calibration.uncertainty.covariance(pixels, np.full(len(pixels), z))[:, 2, 2] for z in (low, high)]
    sd_um = 1e3 * float(np.sqrt(np.nanmean(ends)))
    if sd_um < LEAST_SD_UM:
        return []
    normals = camera.camera_from_board[:, :3, 2] @ camera.camera_from_world[:3, :3]
    tilts = np.degrees(np.arccos(np.clip(normals[:, 2], -1, 1)))
    spread = np.degrees(np.sqrt(np.linalg.eigvalsh(np.cov(normals[:, :2].T))))
    spots = calibration.residuals.centres_px.reshape(-1, 2)
    hull = ConvexHull(spots[np.isfinite(spots[:, 0])])
    inside = (pixels @ hull.equations[:, :2].T + hull.equations[:, 2] <= 0).all(axis=1)
    coverage = float(inside.mean())
    causes = []
    if len(tilts) < calibration.procedure.postures:
        causes.append(f"only {len(tilts)} of {calibration.procedure.postures} postures were used")
    if tilts.max() < 2 * LEAST_TILT_DEG or spread[0] < LEAST_TILT_DEG:
        causes.append(f"tilts reach {tilts.max():.0f}° and scatter by {spread[0]:.1f}° about one axis")
    if coverage < LEAST_COVERAGE:
        causes.append(f"spots cover {100 * coverage:.0f} % of the calibrated field")
    effect = yardstick.rad(sd_um)
    return [
        Finding(
            name="posture set",
            where="board postures",
            effect_rad=effect,
            effect_um=sd_um,
            cause="the postures leave heights at the ends of the range uncertain: "
            + (", ".join(causes) or "too few spots, or too noisy ones"),
            remedy="add postures with tilts of 5 to 25 degrees about different axes, and spots in all corners",
            evidence={
                "height_sd_um": sd_um,
                "postures": float(len(tilts)),
                "largest_tilt_deg": float(tilts.max()),
                "least_tilt_scatter_deg": float(spread[0]),
                "coverage_share": coverage,
            },
        )
    ]


def camera_of(calibration: Calibration) -> CameraCalibration:
    """The camera by the paper's method from the spots that a calibration keeps; the flat posture comes last.

    Raises
    ------
    InputError
        As `calibrate_camera` does.
    """
    centres = calibration.residuals.centres_px
    return calibrate_camera(tuple(centres), calibration.board, calibration.camera.shape, len(centres) - 1)


def posture_names(calibration: Calibration) -> list[str]:
    """Of the postures that were used, as the calibration numbers them."""
    missing = calibration.figures["postures_without_board"]
    tilted = [f"{k:02d}" for k in range(calibration.procedure.postures - 1)]
    return [name for name in (*tilted, "flat") if name not in missing]
