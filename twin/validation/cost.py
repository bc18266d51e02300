"""What one twin costs: its planes after calibrating it, as bias, systematic error and noise in µm, and as predicted.

The whole chain is run: calibration from frames, then planes between its heights, each exposed twice. The product of two
exposures' errors is free of noise on average: its mean is the square of the systematic error.
"""

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from greenough.instrument.contract import Placement
from greenough.instrument.rigfile import load_rig_file
from greenough.pipeline.acquisition import calibrate_by_methods
from greenough.pipeline.calibration import Method
from greenough.pipeline.decode import PhaseMap

from ..rig import open as open_twin
from .height_noise import predicted_noise
from .mechanics import expected_error
from .planes import rms, vertical_error, without_plane
from .setup import Setup
from .structure import structure

METHODS: tuple[Method, ...] = ("bundle", "paper")
HEIGHTS_MM = (-1.22, -0.62, 0.02, 0.62, 1.22)
"""Stage positions of the planes: between the calibration's."""


@dataclass(frozen=True)
class Cost:
    """One twin by one method; lengths in µm, heights unaligned. NaN where a plane was not measured.

    Parameters
    ----------
    calibration : str
        Method of the calibration.
    bias_um : float
        Mean error of all heights.
    systematic_um : float
        Root mean square height error that two exposures have in common.
    systematic_predicted_um : float
        The same from stage, board and table as they are, without a frame: see ``mechanics.expected_error``.
    flatness_um : float
        As ``systematic_um``, about each plane's mean.
    structure_um : float
        Of a single exposure's departures from its best plane: see ``structure.structure``.
    noise_um : float
        Standard deviation of a height between two exposures, over √2.
    noise_predicted_um : float
        The same from the sizes of the effects: see ``height_noise.predicted_noise``.
    step_um : float
        Error of the distance of the outermost planes.
    step_predicted_um : float
        As ``systematic_predicted_um``.
    """

    calibration: str
    bias_um: float
    systematic_um: float
    systematic_predicted_um: float
    flatness_um: float
    structure_um: float
    noise_um: float
    noise_predicted_um: float
    step_um: float
    step_predicted_um: float


@dataclass(frozen=True, eq=False)
class PlaneSeen:
    """A plane at one height, exposed twice; lengths in µm.

    Parameters
    ----------
    errors : (2, rows, cols) float64
        Vertical errors of either exposure, NaN without a point.
    structure : float
        Root mean square of the exposures' structure.
    noise : float
        Predicted for one exposure.
    expected : (places,) float64
        Systematic error that is predicted.
    """

    errors: np.ndarray
    structure: float
    noise: float
    expected: np.ndarray


def measure_cost(rig_name: str, overrides: Sequence[str], run: str, advance: Callable[[float], None]) -> list[Cost]:
    """Calibrate one twin and measure planes, by all methods.

    Parameters
    ----------
    rig_name, overrides
        As ``greenough.twin.open`` takes them.
    run : str
        Whose noise and drifts the exposures have.
    advance : callable
        Called with 1 after each posture, plane and height.

    Raises
    ------
    InputError
        As ``calibrate_by_methods`` does.
    """
    rig, _ = open_twin(rig_name, overrides, run=f"{run} calibration")
    with rig, tempfile.TemporaryDirectory() as folder:
        outs: dict[Method, Path] = {method: Path(folder) / f"{method}.h5" for method in METHODS}
        calibrations = calibrate_by_methods(rig, outs, f"{run} calibration", advance)
    rig, bench = open_twin(rig_name, overrides, run=f"{run} measurement")
    quantised = load_rig_file(rig_name, overrides).camera.bits > 0
    setups = [Setup(rig, bench, calibrations[method]) for method in METHODS]
    seen: list[list[PlaneSeen]] = [[] for _ in setups]
    with rig:
        setups[0].place(Placement("plane"))
        for height in HEIGHTS_MM:
            rig.stage.move_to_mm(height)
            pair = [setups[0].capture(), setups[0].capture()]
            for setup, planes in zip(setups, seen, strict=True):
                planes.append(_see(setup, pair, quantised))
            advance(1)
    return [cost_of(method, planes) for method, planes in zip(METHODS, seen, strict=True)]


def cost_figures(
    rig_name: str, overrides: Sequence[str], run: str, advance: Callable[[float], None]
) -> list[dict[str, float | str]]:
    """`measure_cost` as flat lines, for studies."""
    return [asdict(cost) for cost in measure_cost(rig_name, overrides, run, advance)]


def _see(setup: Setup, pair: Sequence[PhaseMap], quantised: bool) -> PlaneSeen:
    points = [setup.points(phase_map) for phase_map in pair]
    true = np.array([setup.bench.world_from_part[2, 3]])
    return PlaneSeen(
        errors=1e3 * np.stack([vertical_error(setup, each) for each in points]),
        structure=1e3 * _root_of_mean([structure(without_plane(setup, each)) ** 2 for each in points]),
        noise=1e3 * predicted_noise(setup, pair[0], quantised),
        expected=1e3 * expected_error(setup, true)[0],
    )


def cost_of(method: str, planes: Sequence[PlaneSeen]) -> Cost:
    """The figures of one line, from planes at several heights, the lowest first."""
    pairs = [plane.errors for plane in planes]
    common = [first * second for first, second in pairs]
    flat = [(first - _mean(first)) * (second - _mean(second)) for first, second in pairs]
    differences = [first - second for first, second in pairs]
    means = [_mean(pair) for pair in pairs]
    expected = [plane.expected for plane in planes]
    return Cost(
        calibration=method,
        bias_um=float(np.mean(means)),
        systematic_um=_root_of_mean([_mean(product) for product in common]),
        systematic_predicted_um=rms(np.array(expected)),
        flatness_um=_root_of_mean([_mean(product) for product in flat]),
        structure_um=_root_of_mean([plane.structure**2 for plane in planes]),
        noise_um=_root_of_mean([_mean((each - _mean(each)) ** 2) / 2 for each in differences]),
        noise_predicted_um=rms(np.array([plane.noise for plane in planes])),
        step_um=means[-1] - means[0],
        step_predicted_um=float(expected[-1].mean() - expected[0].mean()),
    )


def _mean(values: np.ndarray) -> float:
    """Of all values but NaN; NaN without any."""
    known = values[~np.isnan(values)]
    return float(known.mean()) if len(known) else float("nan")


def _root_of_mean(squares: Sequence[float]) -> float:
    """Noise can make a mean of products negative; a plane that was not measured makes it NaN."""
    return float(np.sqrt(np.maximum(0.0, np.mean(squares))))
