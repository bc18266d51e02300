"""The error budget: what each effect costs, once with everything else on and once with everything else off.

The whole chain is run for each: calibration from frames, then planes between its heights. Products of two exposures'
errors tell what is systematic from what is noise.
"""

import json
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from greenough.instrument.contract import Placement
from greenough.instrument.errors import InputError
from greenough.instrument.files import atomic_path
from greenough.pipeline.acquisition import calibrate_by_methods
from greenough.pipeline.calibration import Method

from ..rig import open as open_twin
from .planes import vertical_error
from .setup import Setup

EFFECTS: dict[str, tuple[str, ...]] = {
    "shot noise": ("twin.camera.shot_noise=false",),
    "read noise": ("twin.camera.read_noise_e=0",),
    "photo response": ("twin.camera.prnu=0",),
    "dark signal": ("twin.camera.dsnu_e=0",),
    "quantisation": ("camera.bits=0",),
    "ambient light": ("twin.light.ambient=0",),
    "flicker": ("twin.stability.flicker=0",),
    "vibration": ("twin.stability.vibration_um=0",),
    "drift of the table": ("twin.stability.table_drift_um=0",),
    "drift of the paths": ("twin.stability.path_drift_um=0",),
    "stage: position": ("twin.stage.position_sd_um=0",),
    "stage: straightness": ("twin.stage.straightness_sd_um=0",),
    "stage: pitch and roll": ("twin.stage.pitch_roll_sd_urad=0",),
    "stage: axis": ("twin.stage.axis_sd_deg=0",),
    "board: print": ("twin.board.print_sd_um=0",),
    "board: scale": ("twin.board.scale_sd_ppm=0",),
    "board: bow": ("twin.board.bow_sd_um=0",),
    "board: wedge": ("twin.board.wedge_sd_urad=0",),
    "board: ink": ("twin.board.ink_thickness_um=0",),
    "camera's diffraction": ("twin.optics.camera_diffraction=false",),
    "finite aperture": ("twin.optics.finite_aperture=false",),
}
"""Every effect of planes and boards, and the settings that switch it off."""

HEIGHTS_MM = (-1.22, -0.62, 0.02, 0.62, 1.22)  # between the calibration's
ALL, NONE = "everything", "nothing"


@dataclass(frozen=True)
class Cost:
    """One line of the budget; lengths in µm.

    Parameters
    ----------
    effects : str
        What was on: "everything", "nothing", "all but X" or "X alone".
    calibration : str
        Method of the calibration.
    systematic_um : float
        Root mean square height error over planes at five heights that two exposures have in common, unaligned.
    flatness_um : float
        The same about each plane's mean.
    noise_um : float
        Standard deviation of a height between two exposures, over √2.
    step_um : float
        Error of the distance of the outermost planes.
    """

    effects: str
    calibration: str
    systematic_um: float
    flatness_um: float
    noise_um: float
    step_um: float


def cases() -> dict[str, tuple[str, ...]]:
    """Names and settings of all lines."""
    off = [setting for settings in EFFECTS.values() for setting in settings]
    lines = {ALL: (), NONE: tuple(off)}
    lines |= {f"all but {name}": settings for name, settings in EFFECTS.items()}
    lines |= {f"{name} alone": tuple(s for s in off if s not in settings) for name, settings in EFFECTS.items()}
    return lines


def budget(rig_name: str, overrides: Sequence[str], out: Path, advance: Callable[[float], None]) -> list[Cost]:
    """Run all cases, which takes a calibration and ten captures each, and write them to ``out`` as JSON.

    The file is written after every case. If it exists, of the same rig and settings, its cases are not run again.

    Raises
    ------
    InputError
        If the rig is not a twin, or ``out`` holds something else.
    """
    rig, _ = open_twin(rig_name, overrides)
    settings = rig.identity.settings_sha256
    costs = _done(out, settings)
    for name, off in cases().items():
        if not any(cost.effects == name for cost in costs):
            costs += _run(rig_name, [*overrides, *off], name)
            with atomic_path(out) as temporary:
                temporary.write_text(json.dumps({"settings": settings, "costs": [asdict(c) for c in costs]}, indent=1))
        advance(1)
    return costs


def _done(out: Path, settings: str) -> list[Cost]:
    if not out.exists():
        return []
    try:
        document = json.loads(out.read_text(encoding="utf-8"))
        same, costs = document["settings"] == settings, [Cost(**cost) for cost in document["costs"]]
    except (ValueError, KeyError, TypeError):
        raise InputError(f"{out} is not an error budget: name another file.") from None
    if not same:
        raise InputError(f"{out} is the budget of other settings or another rig: remove it or name another file.")
    return costs


def _run(rig_name: str, overrides: Sequence[str], name: str) -> list[Cost]:
    """Calibrate and measure one twin by all methods."""
    rig, _ = open_twin(rig_name, overrides, run="budget calibration")
    methods: tuple[Method, ...] = ("bundle", "paper")
    with rig, tempfile.TemporaryDirectory() as folder:
        outs: dict[Method, Path] = {method: Path(folder) / f"{method}.h5" for method in methods}
        calibrations = calibrate_by_methods(rig, outs, "budget calibration")
    rig, bench = open_twin(rig_name, overrides, run="budget measurement")
    setups = [Setup(rig, bench, calibrations[method]) for method in methods]
    pairs: list[list[np.ndarray]] = [[] for _ in setups]
    with rig:
        setups[0].place(Placement("plane"))
        for height in HEIGHTS_MM:
            rig.stage.move_to_mm(height)
            exposures = [[], []]
            for _ in range(2):
                phase_map = setups[0].capture()
                for setup, kept in zip(setups, exposures, strict=True):
                    kept.append(1e3 * vertical_error(setup, setup.points(phase_map)))
            for pair, kept in zip(pairs, exposures, strict=True):
                pair.append(np.stack(kept))
    return [_cost(name, method, pair) for method, pair in zip(methods, pairs, strict=True)]


def _cost(name: str, method: str, pairs: Sequence[np.ndarray]) -> Cost:
    """From the errors of two exposures at each height, (2, rows, cols) µm."""
    common = [first * second for first, second in pairs]
    flat = [(first - np.nanmean(first)) * (second - np.nanmean(second)) for first, second in pairs]
    differences = [first - second for first, second in pairs]
    means = [float(np.nanmean(pair)) for pair in pairs]
    return Cost(
        effects=name,
        calibration=method,
        systematic_um=_root_of_mean(common),
        flatness_um=_root_of_mean(flat),
        noise_um=float(np.sqrt(np.mean([np.nanvar(difference) for difference in differences]) / 2)),
        step_um=means[-1] - means[0],
    )


def _root_of_mean(squares: Sequence[np.ndarray]) -> float:
    """Noise can make a mean of products negative."""
    return float(np.sqrt(max(0.0, np.mean([np.nanmean(square) for square in squares]))))
