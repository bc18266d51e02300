"""Claims about one plane: what one exposure and two scatter by, and what structure is in it."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import erf
from scipy.stats import norm

from greenough.instrument.contract import Placement
from greenough.pipeline.decode import PhaseMap
from greenough.pipeline.phasor_filter import filter_phasors
from greenough.pipeline.reconstruct import PointMap

from .claims import Claim
from .mechanics import calibration_noise, calibration_noise_share, expected_error, percentile_with_noise
from .planes import BLOCK_PX, count, percentile, plane_terms, rms, without_plane
from .setup import Setup
from .structure import common_structure, structure

NOISE_HEIGHT_MM = 0.1
PAPER_LINE, PAPER_ROWS = 330, 960  # the row whose profile the paper shows, and of how many
NOISE_MODEL_TOLERANCE = 0.05
STRUCTURE_LIMIT_UM = 0.5
FILTERED_LIMIT_UM = 0.65
_EVERY = 32  # pixels between those where a smooth shape is predicted


def paper_line(rows: int) -> int:
    """The row of a picture of ``rows`` rows where the paper's profile lies."""
    return PAPER_LINE * rows // PAPER_ROWS


@dataclass(frozen=True, eq=False)
class PlaneNoise:
    """Departures of a plane's points from their best plane, and the scatter that the frames' noise predicts.

    Parameters
    ----------
    raw, second, two_exposures, filtered : (rows, cols) float64
        Of one exposure, of another one, of the mean of the two, and of the first one filtered; mm, NaN without a point.
    noise, filtered_noise : float
        Predicted for one exposure, mm.
    xy : (rows, cols, 2) float32
        Where the points of the first exposure lie, mm; NaN without a point.
    phase : (rows, cols) or None
        Absolute phase of the first exposure, rad.
    """

    raw: np.ndarray
    second: np.ndarray
    two_exposures: np.ndarray
    filtered: np.ndarray
    noise: float
    filtered_noise: float
    xy: np.ndarray
    phase: np.ndarray | None = None


def measure_plane(setups: Sequence[Setup]) -> list[PlaneNoise]:
    """Capture a plane twice, and evaluate it by every calibration."""
    setups[0].place(Placement("plane"), NOISE_HEIGHT_MM)
    first, second = setups[0].capture(), setups[0].capture()
    smoother = filter_phasors(first, setups[0].filter_fwhm_px)
    return [_plane_noise(setup, first, second, smoother) for setup in setups]


def _plane_noise(setup: Setup, first: PhaseMap, second: PhaseMap, smoother: PhaseMap) -> PlaneNoise:
    one, other = setup.points(first), setup.points(second)
    raw = without_plane(setup, one)
    return PlaneNoise(
        raw=raw,
        second=without_plane(setup, other),
        two_exposures=without_plane(setup, PointMap((one.xyz + other.xyz) / 2)),
        filtered=without_plane(setup, setup.points(smoother)),
        noise=rms(setup.height_sigma(first)[np.isfinite(raw)]),
        filtered_noise=rms(setup.height_sigma(smoother)[np.isfinite(raw)]),
        xy=one.xyz[..., :2].astype(np.float32),
        phase=first.absolute,
    )


def noise_claims(setup: Setup, plane: PlaneNoise) -> Iterator[Claim]:
    """What one and two exposures of a plane scatter by, about the best plane through them.

    Predicted from the frames' noise, the calibration's, and the shape that the calibration took for flat. Left out are
    structure that the bundle's fit leaves, flicker, and whatever else the noise's model does not know: the spread of a
    prediction is that of the sample alone, σ / √(2n) for n independent normal deviates, and cannot excuse these.
    """
    raw, two, filtered = plane.raw, plane.two_exposures, plane.filtered
    everywhere, on_line = _expected_shape(setup, plane.xy)
    shape = rms(everywhere)
    fixed = calibration_noise_share(setup, np.array([NOISE_HEIGHT_MM])) * (calibration_noise(setup) or plane.noise)

    def scatter(measurement: float) -> float:
        return 1e3 * float(np.sqrt(shape**2 + measurement**2 + fixed**2))

    one = scatter(plane.noise)
    rmse = "root mean square about the best plane"
    for name, departures, measurement, alike, filter, limit, criterion in (
        ("raw", raw, plane.noise, 1.0, "none", 1.223, f"{rmse}, one exposure"),
        ("two_exposures", two, plane.noise / np.sqrt(2), 1.0, "mean of two exposures", 1.223, f"{rmse}, two exposures"),
        (
            "filtered", filtered, plane.filtered_noise, filtered_alike(setup.filter_fwhm_px), setup.filter_name,
            1.223 if setup.believes_stage else FILTERED_LIMIT_UM, f"{rmse}, one exposure",
        ),
    ):  # fmt: skip
        expected = scatter(measurement)
        yield setup.claim(
            f"plane_rmse_{name}", "plane", 1e3 * rms(departures), "um", count(departures), criterion,
            paper=1.223, limit=limit, filter=filter, alignment="best plane",
            predicted=expected,
            predicted_sd=expected * float(np.sqrt(alike / (2 * max(count(departures), 1)))),
        )  # fmt: skip
    ratio = 1e3 * rms(raw) / one
    judged = not setup.believes_stage
    yield setup.claim(
        "plane_noise_ratio", "plane", ratio, "1", count(raw),
        f"plane_rmse_raw over its prediction is 1 to {NOISE_MODEL_TOLERANCE:g}", alignment="best plane",
        limit=NOISE_MODEL_TOLERANCE if judged else None,
        holds=abs(ratio - 1) <= NOISE_MODEL_TOLERANCE if judged else None,
    )  # fmt: skip
    within = float(np.mean(np.abs(raw[np.isfinite(raw)]) <= 5e-3)) if count(raw) else np.nan
    expected = float(erf(5 / one / np.sqrt(2)))
    yield setup.claim(
        "plane_within_5um", "plane", within, "1", count(raw), "share of departures within 5 um is at least 0.95",
        limit=0.95, at_least=True, alignment="best plane", predicted=expected,
        predicted_sd=np.sqrt(expected * (1 - expected) / max(count(raw), 1)),
    )  # fmt: skip
    yield _line_claim(setup, plane, on_line, float(np.hypot(plane.noise, fixed)))
    yield from _structure_claims(setup, plane, 1e3 * shape)


def _line_claim(setup: Setup, plane: PlaneNoise, shape: np.ndarray, sigma: float) -> Claim:
    row = paper_line(len(plane.raw))
    line = np.abs(plane.raw[row])
    line = line[np.isfinite(line)]
    return setup.claim(
        "plane_line_noise", "plane", 1e3 * percentile(line, 95), "um", len(line),
        f"95 % of the departures along image row {row}", paper=4.0, limit=4.0, alignment="best plane",
        predicted=1e3 * percentile_with_noise(shape, sigma, 0.95),
        predicted_sd=1e3 * quantile_sd(float(np.hypot(sigma, rms(shape))), 0.95, len(line)),
    )  # fmt: skip


def _structure_claims(setup: Setup, plane: PlaneNoise, shape_um: float) -> Iterator[Claim]:
    blocks = f"means over blocks of {BLOCK_PX} x {BLOCK_PX} px"
    limit, predicted = (None, shape_um) if setup.believes_stage else (STRUCTURE_LIMIT_UM, None)
    yield setup.claim(
        "plane_structure", "plane", 1e3 * structure(plane.raw), "um", count(plane.raw),
        "root mean square of the means beyond what white noise gives them, one exposure", limit=limit,
        filter=blocks, alignment="best plane", predicted=predicted,
    )  # fmt: skip
    yield setup.claim(
        "plane_structure_common", "plane", 1e3 * common_structure(plane.raw, plane.second), "um", count(plane.raw),
        "what two exposures share of it: the calibration's part, without flicker and vibration", filter=blocks,
        alignment="best plane", predicted=predicted,
    )  # fmt: skip


def _expected_shape(setup: Setup, xy: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What the calibration takes for flat at points whose places are ``xy`` (rows, cols, 2).

    Departures in mm from the best plane over the field, at some points all over it and at some along the paper's line.
    """
    height = np.array([NOISE_HEIGHT_MM])
    field, line = (
        places[np.isfinite(places[:, 0])]
        for places in (xy[::_EVERY, ::_EVERY].reshape(-1, 2), xy[paper_line(len(xy)), :: _EVERY // 4])
    )
    error = expected_error(setup, height, field)[0]
    plane = np.linalg.lstsq(plane_terms(field), error, rcond=None)[0]
    return error - plane_terms(field) @ plane, expected_error(setup, height, line)[0] - plane_terms(line) @ plane


def filtered_alike(fwhm_px: float) -> float:
    """How many filtered pixels of white noise tell as much about its variance as one independent value does.

    Under a Gaussian of standard deviation s pixels the noise's autocorrelation is ρ = exp(-r² / 4s²), and a mean of
    squares has the variance 2σ⁴ / n Σ ρ²: 2π s² times as much as of independent values.
    """
    return max(1.0, 2 * np.pi * (fwhm_px / (2 * np.sqrt(2 * np.log(2)))) ** 2)


def quantile_sd(sigma: float, share: float, n: int) -> float:
    """Standard deviation of the ``share``-quantile of |x| in a sample of ``n`` normal deviates of ``sigma``.

    √(p (1 - p) / n) / f, where f = 2 φ(q / σ) / σ is the density of |x| at the quantile q.
    """
    if n == 0:
        return np.nan
    density = 2 * norm.pdf(norm.ppf((1 + share) / 2)) / sigma
    return float(np.sqrt(share * (1 - share) / n) / density)
