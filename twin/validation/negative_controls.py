"""Negative controls: errors that are planted in a twin, and the rows about it that must turn red for each.

A row proves something only if it can fail. Of every control the rows that must fail are named beforehand, with the size
of the failure where analysis gives it, and the same rows must hold for the same twin without the error.

- A calibration board printed too large by 1 ‰ makes all lengths too short by as much. Nothing in the calibration can
  tell, so the rows are those of a step and of a second board.
- A rig file with a wrong pitch is the same by another mistake: the board has the pitch that it was bought with.
- Of a gamma that nobody corrected, three steps take the second harmonic for the fundamental: its share of the
  fundamental turns the phase by that angle, three times in a fringe.
- A stage that errs by 10 µm, where the paper's method takes its readings for true.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import cache
from itertools import chain
from math import nan
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from scipy.special import binom

from greenough.instrument.contract import Procedure
from greenough.pipeline.acquisition import calibrate_by_methods
from greenough.pipeline.calibration import Calibration, Method

from ..diffraction import optical_transfer
from ..rig import open as open_twin
from ..settings import OpticsSettings
from .claims import Claim
from .coarse_stage import coarse_stage_claims
from .noise import measure_plane, noise_claims
from .pitch import SECOND, measure_boards, pitch_claims
from .setup import Setup
from .step import STEP_MM, step_claims

SCALE_ERROR = 1e-3
SCALE_TOLERANCE = 0.03e-3
"""By how much the change of the second board's mean pitch may differ from the scale error, as a share of the pitch."""

WRONG_PITCH_MM, PRINTED_PITCH_MM = 0.66, 0.65
GAMMA = 1.8
RIPPLE_TOLERANCE = 0.15
"""Of the predicted scatter: lenses that are not in focus pass less of the second harmonic than is predicted."""

STAGE_SD_UM = 10.0

_STEP, _PITCH_ERROR, _PITCH = "step_2500um", f"{SECOND}_error_mean_all_spots", f"{SECOND}_mean_all_spots"
_EXACT_BUT_FOR_HEIGHT = (
    *(f"twin.stage.{name}=0" for name in ("straightness_sd_um", "pitch_roll_sd_urad", "axis_sd_deg")),
    *(f"twin.board.{name}=0" for name in ("bow_sd_um", "wedge_sd_urad")),
    *(f"twin.stability.{name}=0" for name in ("table_drift_um", "path_drift_um")),
)

Rows = dict[str, Claim]
Advance = Callable[[float], None]
Measure = Callable[[str, Sequence[str], str, Advance], Rows]


@dataclass(frozen=True)
class Finding:
    """One row with the error and without it.

    Parameters
    ----------
    control, row, unit : str
    sound, planted : float
        What was measured without the error and with it, in ``unit``.
    predicted : float
        Of ``planted``, by analysis; NaN where none is made.
    limit : float
        What ``sound`` must keep to and ``planted`` must not; of a row that is predicted to be so, the largest
        difference of ``planted`` from it.
    as_expected : bool
    """

    control: str
    row: str
    unit: str
    sound: float
    planted: float
    predicted: float
    limit: float
    as_expected: bool


def negative_controls(rig_name: str, overrides: Sequence[str], run: str, advance: Advance) -> list[Finding]:
    """Plant every error in turn, calibrate and measure each time.

    Parameters
    ----------
    rig_name, overrides
        As ``greenough.twin.open`` takes them.
    run : str
        Begins the names of the runs. The twins with and without an error share their noise.
    advance : callable
        Called with 1 after each step of a calibration.

    Raises
    ------
    InputError
        If a twin cannot be calibrated or measured.
    """

    @cache
    def rows(measure: Measure, more: tuple[str, ...]) -> Rows:
        return measure(rig_name, (*overrides, *more), run, advance)

    lengths = [*_scale(rows), *_wrong_pitch(rows)]
    gamma = list(_gamma(rows, rig_name, overrides))
    stages = _exact_and_coarse_stage(rig_name, (*overrides, *_EXACT_BUT_FOR_HEIGHT), run, advance)
    return [*lengths, *gamma, *_stage(*stages)]


def control_figures(
    rig_name: str, overrides: Sequence[str], run: str, advance: Advance
) -> list[dict[str, float | str]]:
    """`negative_controls` as flat figures; ``unexpected`` is 1 where a row stays green, or is red without the error."""
    found = [asdict(finding) for finding in negative_controls(rig_name, overrides, run, advance)]
    return [row | {"unexpected": float(not row.pop("as_expected"))} for row in found]


MeasuredRows = Callable[[Measure, tuple[str, ...]], Rows]


def _scale(rows: MeasuredRows) -> Iterator[Finding]:
    control = "board printed too large by 1 per mille"
    sound, planted = rows(_lengths, ()), rows(_lengths, (f"twin.board.scale_error_ppm={1e6 * SCALE_ERROR:g}",))
    yield from _too_short(control, sound, planted, SCALE_ERROR)
    mean = sound[_PITCH].measured
    expected, limit = mean * (1 + _change(SCALE_ERROR)), mean * SCALE_TOLERANCE
    yield Finding(
        control, f"{_PITCH}: changes as the scale", sound[_PITCH].unit, mean, planted[_PITCH].measured, expected, limit,
        abs(planted[_PITCH].measured - expected) <= limit,
    )  # fmt: skip


def _wrong_pitch(rows: MeasuredRows) -> Iterator[Finding]:
    error = PRINTED_PITCH_MM / WRONG_PITCH_MM - 1
    plant = (f"board.pitch_mm={WRONG_PITCH_MM}", f"twin.board.scale_error_ppm={1e6 * error:.6g}")
    control = f"pitch of {WRONG_PITCH_MM:g} mm in the rig file, {PRINTED_PITCH_MM:g} mm on the board"
    yield from _too_short(control, rows(_lengths, ()), rows(_lengths, plant), error)


def _gamma(rows: MeasuredRows, rig_name: str, overrides: Sequence[str]) -> Iterator[Finding]:
    control = f"gamma of {GAMMA:g}, three steps"
    rig, bench = open_twin(rig_name, overrides)
    three = (f"procedure.steps={[3] * len(rig.procedure.steps)}",)
    sound, planted = (rows(_one_plane, (*three, *more)) for more in ((), (f"twin.optics.gamma={GAMMA}",)))
    # Not plane_structure: the ripple's three periods in a fringe cancel in the means over blocks, but for chance.
    yield _turned_red(control, sound["plane_noise_ratio"], planted["plane_noise_ratio"])
    scatter = planted["plane_rmse_raw"]
    ripple_um = 1e3 * ripple_mm(GAMMA, 3, bench.settings.optics, rig.procedure)
    expected = float(np.hypot(scatter.predicted or nan, ripple_um))  # the row's own prediction is noise
    limit = RIPPLE_TOLERANCE * expected
    yield Finding(
        control, "plane_rmse_raw: noise and the ripple", scatter.unit, sound["plane_rmse_raw"].measured,
        scatter.measured, expected, limit, abs(scatter.measured - expected) <= limit,
    )  # fmt: skip


def _stage(sound: Rows, planted: Rows) -> Iterator[Finding]:
    for name in ("depth_systematic_rms", "depth_systematic_p99", "stages_within_4um"):
        yield _turned_red(f"stage of {STAGE_SD_UM:g} um, the paper's method", sound[name], planted[name])


def _too_short(control: str, sound: Rows, planted: Rows, error: float) -> Iterator[Finding]:
    """A step and a second board, measured after a board whose spots are farther apart by ``error`` than was thought."""
    for name, length_um in ((_STEP, 1e3 * STEP_MM), (_PITCH_ERROR, 1e3 * sound[_PITCH].measured)):
        yield _turned_red(control, sound[name], planted[name], sound[name].measured + length_um * _change(error))


def _change(error: float) -> float:
    """By what share lengths change that are measured with a scale too large by ``error``."""
    return 1 / (1 + error) - 1


def _turned_red(control: str, sound: Claim, planted: Claim, predicted: float | None = None) -> Finding:
    expected = planted.predicted if predicted is None else predicted
    limit = planted.limit
    assert limit is not None
    return Finding(
        control, sound.claim, sound.unit, sound.measured, planted.measured, nan if expected is None else expected,
        limit, sound.holds is True and planted.holds is False,
    )  # fmt: skip


def ripple_mm(gamma: float, steps: int, optics: OpticsSettings, procedure: Procedure) -> float:
    """Root mean square of the heights' error by a projector's ``gamma``, in focus on both axes, mm.

    The light's harmonics over the grey values are those of ((1 + cos φ) / 2)^gamma. With N steps the harmonics 1 ± N,
    1 ± 2N, ... are taken for the fundamental: the phase is that of Σ_m c_(1 + mN) exp(i (1 + mN) φ). Mirrors, lenses
    of both paths and the camera's pixels pass the less of a harmonic the higher it is.
    """
    period_mm = 1e-3 * optics.column_pitch_um * procedure.periods_px[-1]
    orders = 1 + steps * np.arange(-2, 3)
    frequency = np.abs(orders) / period_mm
    lens = optical_transfer(frequency, optics.na, 1e-3 * optics.wavelength_um)
    mirrors = np.sinc(frequency * np.sqrt(optics.mirror_fill) * 1e-3 * optics.column_pitch_um / 2) ** 2
    pixels = np.sinc(frequency * optics.pupil_distance_mm / optics.camera_focal_px)
    passed = mirrors * lens ** (1 + optics.camera_diffraction) * pixels
    # ((1 + cos φ) / 2)^γ = cos(φ / 2)^2γ has the coefficients binom(2γ, γ + k) / 4^γ.
    amplitudes = binom(2 * gamma, gamma + np.abs(orders)) / 4**gamma * passed
    phase = np.linspace(0, 2 * np.pi, 720, endpoint=False)
    error = np.angle(np.sum(amplitudes * np.exp(1j * (orders - 1) * phase[:, None]), axis=1))
    mm_per_rad = period_mm / (2 * np.pi) / (2 * np.sin(np.radians(optics.convergence_deg / 2)))
    return float(np.sqrt(np.mean(error**2)) * mm_per_rad)


def _lengths(rig_name: str, overrides: Sequence[str], run: str, advance: Advance) -> Rows:
    setup = _calibrated(rig_name, overrides, run, "bundle", advance)
    pitch = (row for board in measure_boards([setup]) for row in pitch_claims([setup], board))
    return _by_name(chain(step_claims([setup]), pitch))


def _one_plane(rig_name: str, overrides: Sequence[str], run: str, advance: Advance) -> Rows:
    setup = _calibrated(rig_name, overrides, run, "bundle", advance)
    return _by_name(noise_claims(setup, measure_plane([setup])[0]))


def _exact_and_coarse_stage(rig_name: str, overrides: Sequence[str], run: str, advance: Advance) -> tuple[Rows, Rows]:
    paper = _calibration(rig_name, overrides, run, "paper", advance)
    exact, coarse = (
        _by_name(coarse_stage_claims(rig_name, overrides, paper, advance, sd)) for sd in (0.0, STAGE_SD_UM)
    )
    return exact, coarse


def _by_name(claims: Iterator[Claim]) -> Rows:
    return {claim.claim: claim for claim in claims}


def _calibrated(rig_name: str, overrides: Sequence[str], run: str, method: Method, advance: Advance) -> Setup:
    calibration = _calibration(rig_name, overrides, run, method, advance)
    rig, bench = open_twin(rig_name, overrides, run=f"{run} measurement")
    return Setup(rig, bench, calibration)


def _calibration(rig_name: str, overrides: Sequence[str], run: str, method: Method, advance: Advance) -> Calibration:
    name = f"{run} calibration"
    rig, _ = open_twin(rig_name, overrides, run=name)
    with rig, TemporaryDirectory() as folder:
        return calibrate_by_methods(rig, {method: Path(folder) / "calibration.h5"}, name, advance)[method]
