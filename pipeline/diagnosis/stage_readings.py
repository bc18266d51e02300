"""The stage's readings against the heights at which a calibration by the board's scale finds the planes."""

import numpy as np
from scipy.stats import t as student

from ..blas import on_one_thread
from .finding import FALSE_ALARM, Finding, Yardstick

MIN_PLANES = 7

_DEGREE = 1  # an offset and a scale are no slip


@on_one_thread
def check_stage(readings_mm: np.ndarray, heights_mm: np.ndarray, yardstick: Yardstick) -> list[Finding]:
    """A jump of the stage, or a single plane at which it stood elsewhere.

    Readings depart from heights by an offset, a scale and scatter. For each place of a jump and each single plane, the
    departure there is fitted beside these; the one that explains most is reported where Student's t, with the
    scatter that is left over, exceeds what chance does with ``FALSE_ALARM`` over all places.

    Parameters
    ----------
    readings_mm, heights_mm : (planes,)
        In the order in which the planes were taken.
    """
    planes = len(readings_mm)
    if planes < MIN_PLANES:
        return []
    departure_um = 1e3 * (heights_mm - readings_mm)
    x = (readings_mm - readings_mm.mean()) / max(np.ptp(readings_mm) / 2, 1e-9)
    line = np.vander(x, _DEGREE + 1)
    at = np.arange(planes)
    steps = [("slip", k, (at >= k).astype(float)) for k in range(1, planes)]
    spikes = [("single", k, (at == k).astype(float)) for k in range(1, planes - 1)]
    fits = [(*_fit(departure_um, line, extra), kind, k) for kind, k, extra in (*steps, *spikes)]
    statistic, jump_um, kind, k = max(fits)
    freedom = planes - _DEGREE - 2
    effect_um = _effect(departure_um, line)
    if statistic < student.isf(FALSE_ALARM / 2 / len(fits), freedom) or effect_um < yardstick.least_um:
        return []
    what = f"from plane {k:02d} on" if kind == "slip" else f"at plane {k:02d}"
    effect = yardstick.rad(effect_um)
    return [
        Finding(
            name="stage slip",
            where=f"stage, {what} (reading {readings_mm[k]:g} mm)",
            effect_rad=effect,
            effect_um=effect_um,
            cause=f"the stage stood {jump_um:+.1f} µm off its readings {what}: it slipped or lost steps",
            remedy="home the stage, check its coupling, load and clamp, and calibrate again; the bundle takes no "
            "heights from readings and is not moved by this, the paper's method is",
            evidence={"jump_um": float(jump_um), "students_t": float(statistic), "departure_rms_um": effect_um},
        )
    ]


def _fit(departure: np.ndarray, line: np.ndarray, extra: np.ndarray) -> tuple[float, float]:
    """Student's t and size of ``extra`` beside offset and scale."""
    design = np.column_stack([line, extra])
    inverse = np.linalg.pinv(design.T @ design)
    fitted = inverse @ design.T @ departure
    left = departure - design @ fitted
    variance = left @ left / (len(departure) - design.shape[1]) * inverse[-1, -1]
    return float(abs(fitted[-1]) / np.sqrt(max(variance, 1e-18))), float(fitted[-1])


def _effect(departure: np.ndarray, line: np.ndarray) -> float:
    """Root mean square of what no offset and no scale explain, µm: heights that are believed to readings err so."""
    return float(np.std(departure - line @ np.linalg.lstsq(line, departure, rcond=None)[0]))
