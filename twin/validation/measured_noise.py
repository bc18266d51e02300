"""Measurement noise on the material itself: what two exposures differ by, over what the pipeline states of each.

Two maps of one place are subtracted pixel by pixel. What they have in common drops out: the surface, the calibration's
errors, fixed patterns of the camera, interreflections. What is left is to be as large as the standard deviations that
were stated, as a whole and in every class of modulation and slope, since errors that compensate would not be seen as a
whole. Flicker and vibration are no noise of single pixels and are not in what is stated: a twin with ``STEADY`` has
neither, and its rows must keep to the limit; otherwise rows only report.

Of a part that one exposure suffices for, the variance of the phase is also compared with the least that any estimate
could have, `pipeline.phase_bound`: pixel by pixel, with the camera's data sheet and whole grey values.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np

from greenough.instrument.contract import Placement
from greenough.pipeline.acquisition import measure_phase
from greenough.pipeline.decode import PhaseMap
from greenough.pipeline.metrology.measurement_noise import noise_by_subtraction
from greenough.pipeline.phase_bound import grey_information, phase_bound
from greenough.pipeline.phasor_filter import filter_phasors

from .claims import Claim
from .measured import FILTERED, RAW, SHINY, filter_name
from .planes import rms
from .setup import Setup

SPECIMENS = ("plane", "coin", "bga")
STEADY = ("twin.stability.flicker=0", "twin.stability.vibration_um=0")
"""Overrides of a twin whose noise is that of single pixels."""

RATIO_TOLERANCE = 0.05
"""Of measured over stated noise: chosen, as the next one is."""

BOUND_LIMIT = 1.05
"""Of the variance over the bound of Cramér and Rao."""

MODULATION_CLASSES = 5
SLOPES_DEG = (0.0, 10.0, 20.0, 30.0, 45.0, 90.0)
LEAST_PIXELS = 1000
"""Of a class that has a row, whose ``predicted_sd`` says how well their noise is known."""

_LIGHT_LEVELS = 200  # between which the information of a grey value is interpolated
_AT_ONCE = 50_000  # pixels

_REACH = 1.7  # full widths at half maximum from the middle of a Gaussian to where the filter ends, 4 sigmas


@dataclass(frozen=True, eq=False)
class Repeated:
    """One specimen measured twice. All arrays are (rows, cols).

    Parameters
    ----------
    specimen, treatment : str
        Treatment of the phase: ``RAW`` or ``FILTERED``.
    first, second : float64
        Heights, mm; NaN without a point.
    sigma : float64
        Stated standard deviation of one height, mm: root mean square of both maps'.
    modulation : float32
        Of the first map, DN.
    slope_deg : float64
        Angle of the true surface against the horizontal.
    inside : bool
        Where the filter's whole reach is measured in both maps; everywhere, if nothing is filtered.
    """

    specimen: str
    treatment: str
    first: np.ndarray
    second: np.ndarray
    sigma: np.ndarray
    modulation: np.ndarray
    slope_deg: np.ndarray
    inside: np.ndarray

    @property
    def suffix(self) -> str:
        """How names of its rows end."""
        return "" if self.treatment == RAW else f"_{self.treatment}"


@dataclass(frozen=True)
class NoiseRatio:
    """Measured noise, mm, over what was stated of the same n pixels; ``sd`` is that of the ratio, by chance alone."""

    measured: float
    stated: float
    sd: float
    n: int

    @property
    def ratio(self) -> float:
        return self.measured / self.stated


def noise_rows(setup: Setup, specimens: Sequence[str] = SPECIMENS) -> Iterator[Claim]:
    """Measured over stated noise of each specimen, as it is and with the one filter.

    Parameters
    ----------
    setup : Setup
        Its run has none of the calibration's exposures. Its rig may be ``STEADY`` where the calibrated one was not.
    specimens : sequence of str
        Names of samples; each is measured twice.
    """
    for name in specimens:
        pair = phase_pair(setup, name)
        for repeated in treated(setup, name, pair):
            yield from ratio_rows(setup, repeated)
        if name not in SHINY:
            yield bound_row(setup, name, pair)


def phase_pair(setup: Setup, name: str) -> list[PhaseMap]:
    """Measure one specimen twice, shiny ones by several exposures each."""
    brackets = setup.calibration.procedure.brackets if name in SHINY else (1.0,)
    return [measure_phase(setup.rig, setup.calibration, Placement(name), brackets) for _ in range(2)]


def treated(setup: Setup, name: str, pair: Sequence[PhaseMap]) -> list[Repeated]:
    """The specimen that is mounted, from two phase maps of it: raw and filtered."""
    slope_deg = np.degrees(np.arccos(np.clip(setup.bench.truth().normal_world[..., 2], -1, 1)))
    width = setup.filter_fwhm_px
    both = pair[0].valid & pair[1].valid
    reach = int(np.ceil(_REACH * width))
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
    surrounded = cv2.erode(both.astype(np.uint8), disc).astype(bool)
    smoothed = [filter_phasors(phase_map, width) for phase_map in pair]
    return [
        _repeated(setup, name, RAW, pair, slope_deg, np.ones_like(both)),
        _repeated(setup, name, FILTERED, smoothed, slope_deg, surrounded),
    ]


def _repeated(
    setup: Setup, name: str, treatment: str, pair: Sequence[PhaseMap], slope_deg: np.ndarray, inside: np.ndarray
) -> Repeated:
    maps = [setup.points(phase_map) for phase_map in pair]
    first, second = (points.xyz[..., 2] for points in maps)
    variances = [points.sigma_noise[..., 2].astype(np.float64) ** 2 for points in maps]
    sigma = np.sqrt((variances[0] + variances[1]) / 2)
    return Repeated(name, treatment, first, second, sigma, pair[0].modulation, slope_deg, inside)


def noise_ratio(repeated: Repeated, where: np.ndarray) -> NoiseRatio:
    """Of the pixels ``where`` (rows, cols) that have a height in both maps.

    Raises
    ------
    InputError
        If these are fewer than 100.
    """
    first = np.where(where, repeated.first, np.nan)
    found = noise_by_subtraction(first, repeated.second)
    stated = rms(repeated.sigma[np.isfinite(first) & np.isfinite(repeated.second)])
    return NoiseRatio(found.noise, stated, found.relative_sd * found.noise / stated, found.n)


def bound_row(setup: Setup, name: str, pair: Sequence[PhaseMap]) -> Claim:
    """Variance of the phase over the least that is possible, averaged over the pixels of two phase maps."""
    first, second = pair
    seen = first.valid & second.valid
    background, modulation = (
        (getattr(first, what)[seen] + getattr(second, what)[seen]).astype(np.float64) / 2
        for what in ("background", "modulation")
    )
    phase = first.absolute[seen].astype(np.float64)
    light = np.geomspace(0.02, max(1.0, float((background + modulation).max(initial=0))), _LIGHT_LEVELS)
    information = grey_information(light, setup.rig.camera.noise, quantised=True)
    parts = np.array_split(np.arange(len(phase)), max(1, len(phase) // _AT_ONCE))
    bound = np.concatenate(
        [
            phase_bound(
                background[k], modulation[k], phase[k], setup.calibration.procedure.steps[-1],
                lambda at: np.interp(at, light, information),
            )
            for k in parts
        ]
    )  # fmt: skip
    difference = phase - second.absolute[seen]
    excess = (difference - difference.mean()) ** 2 / 2 / bound
    steady = _steady(setup)
    return setup.claim(
        "phase_variance_over_bound", name, float(excess.mean()), "1", len(excess),
        "half the squared difference of two phase maps, over the bound of Cramér and Rao with Poisson, normal and "
        f"rounding noise: at most {BOUND_LIMIT:g} without flicker and vibration",
        limit=BOUND_LIMIT if steady else None, predicted=1.0, predicted_sd=float(np.sqrt(2 / max(len(excess), 1))),
        expected_to_hold=True if steady else None,
    )  # fmt: skip


def _steady(setup: Setup) -> bool:
    stability = setup.bench.settings.stability
    return stability.flicker == stability.vibration_um == 0


def ratio_rows(setup: Setup, repeated: Repeated) -> Iterator[Claim]:
    """The ratio of one specimen and treatment, as a whole and in classes of modulation and of slope."""
    filter, suffix = filter_name(setup, repeated.treatment), repeated.suffix
    everywhere = np.ones_like(repeated.inside)
    subtracted = "two maps subtracted, over √2"

    def row(name: str, of: NoiseRatio, which: str, limit: float | None = None) -> Claim:
        return setup.claim(
            name + suffix, repeated.specimen, of.ratio, "1", of.n,
            f"{subtracted}, over what is stated of the same pixels: {which}", limit=limit, filter=filter,
            holds=None if limit is None else abs(of.ratio - 1) <= limit, predicted=1.0, predicted_sd=of.sd,
            expected_to_hold=None if limit is None else True,
        )  # fmt: skip

    counted = noise_ratio(repeated, repeated.inside)
    yield setup.claim(
        f"noise{suffix}", repeated.specimen, 1e3 * counted.measured, "um", counted.n,
        f"measurement noise: {subtracted}", filter=filter,
        predicted=1e3 * counted.stated, predicted_sd=1e3 * counted.stated * counted.sd,
    )  # fmt: skip
    where = "all" if repeated.inside.all() else "whose surroundings within the filter's reach are measured"
    limit = RATIO_TOLERANCE if _steady(setup) else None
    yield row("noise_ratio", counted, f"1 to {RATIO_TOLERANCE:g} without flicker and vibration; {where}", limit)
    if not repeated.inside.all():
        yield row("noise_ratio_everywhere", noise_ratio(repeated, everywhere), "edges and rims included")
    for name, which, chosen in _classes(repeated):
        yield row(f"noise_ratio_{name}", noise_ratio(repeated, chosen), which)


def _classes(repeated: Repeated) -> Iterator[tuple[str, str, np.ndarray]]:
    """Name, description and pixels (rows, cols) bool of every class of modulation and of slope with enough pixels."""
    measured = repeated.inside & np.isfinite(repeated.first) & np.isfinite(repeated.second)
    if measured.sum() < MODULATION_CLASSES * LEAST_PIXELS:
        return
    bounds = np.quantile(repeated.modulation[measured], np.linspace(0, 1, MODULATION_CLASSES + 1))
    bounds[-1] = np.inf
    for k, (low, high) in enumerate(pairwise(bounds), start=1):
        chosen = measured & (repeated.modulation >= low) & (repeated.modulation < high)
        yield f"modulation_{k}", f"modulation from {low:.4g} DN, class {k} of {MODULATION_CLASSES}", chosen
    for low, high in pairwise(SLOPES_DEG):
        chosen = measured & (repeated.slope_deg >= low) & (repeated.slope_deg < high)
        if chosen.sum() >= LEAST_PIXELS:
            yield f"slope_{low:g}_{high:g}deg", f"true slopes from {low:g}° to {high:g}°", chosen
